"""The poses of a pair that are scored: hypotheses of the registration, and slides along the weakest direction."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.types import Registration, Rejected, Transform
from segslam.registration import refinement
from segslam.registration.hypotheses import coarse_poses
from segslam.verification.trial import Trial, few_points, is_near

NUM_REFINED, NUM_SLIDES = 3, 2
"""Chosen: poses refined with all points of those to which few points lead, by their mismatch."""
SLIDES_M = (1, 2, 3, 5, 8)
"""Chosen: slides tried, both ways."""
NEW_M, NEW_RAD = 0.3, math.radians(1.0)
"""Chosen: a pose nearer than this to another is the same."""
MOST_MOVED_M = 4.0
"""Chosen: few points move a hypothesis by this much at most."""


class _Led(NamedTuple):
    """Where few points lead."""

    mismatch: float
    T_target_source: Transform


def tried(trial: Trial) -> list[Transform]:
    """Refined poses, each different from the others; of the gates only that of the prior applies."""
    if min(len(few_points(trial.source, trial.config.refine).surface), len(trial.target.surface)) < (
        refinement.MIN_POINTS
    ):
        return []
    coarse = (one.T_target_source for one in coarse_poses(trial.pair) if isinstance(one, Registration))
    found = _refined(trial, _led(trial, coarse, [])[:NUM_REFINED], [])
    if not found:
        return []
    best = min(found, key=lambda fine: trial.mismatch(fine.T_target_source))
    poses = [fine.T_target_source for fine in found]
    slid = _led(trial, _slides(best), poses)[:NUM_SLIDES]
    return poses + [fine.T_target_source for fine in _refined(trial, slid, poses)]


def _slides(pose: Registration) -> Iterator[Transform]:
    weakest = refinement.weakest_level(pose.information)
    for way in (1.0, -1.0):
        for slide_m in SLIDES_M:
            yield pose.T_target_source @ geometry.transform(np.eye(3), way * slide_m * weakest)


def _led(trial: Trial, starts: Iterator[Transform], known: list[Transform]) -> list[_Led]:
    """Poses to which few points lead, other than known ones, the best first."""
    few = few_points(trial.source, trial.config.refine)
    found: list[_Led] = []
    for T_start in starts:
        if trial.gate(T_start, slack_m=trial.config.verify.max_coarse_fine_m) is not None:
            continue
        fine = refinement.refine(
            few.surface, trial.target.surface, T_start, config=trial.config.refine, must_converge=False
        )
        if isinstance(fine, Rejected):
            continue
        T_led = fine.T_target_source
        moved_m = geometry.distance(geometry.inverse(T_start) @ T_led)
        others = [*known, *(led.T_target_source for led in found)]
        if moved_m <= MOST_MOVED_M and not is_near(T_led, others, within_m=NEW_M, within_rad=NEW_RAD):
            found.append(_Led(trial.mismatch_of_few(few, T_led), T_led))
    return sorted(found, key=lambda led: led.mismatch)


def _refined(trial: Trial, starts: list[_Led], known: list[Transform]) -> list[Registration]:
    """Poses refined with all points, other than known ones, that the prior allows."""
    found: list[Registration] = []
    for led in starts:
        fine = refinement.refine(
            trial.source.surface,
            trial.target.surface,
            led.T_target_source,
            config=trial.config.refine,
            must_converge=False,
        )
        if isinstance(fine, Rejected) or trial.gate(fine.T_target_source, slack_m=0.0) is not None:
            continue
        others = [*known, *(one.T_target_source for one in found)]
        if not is_near(fine.T_target_source, others, within_m=NEW_M, within_rad=NEW_RAD):
            found.append(fine)
    return found
