"""Rivals: other poses that may explain the two scans as well as one that was found."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from segslam import geometry, refinement
from segslam.registration.hypotheses import plans_near
from segslam.registration.trial import EQUAL_M, EQUAL_RAD, FEW_RATIO, Found, Trial, anywhere, few_points, is_near
from segslam.types import Direction, Registration, Rejected, Transform

MOST_SHIFT_M = 8
"""Chosen: largest shift along the weak direction at which rivals are searched, in steps of 1 m; refinement finds rivals
within 0.5 m."""
APPROACH_RATIO = 0.3
"""Chosen: a rival is dropped if, after the first iterations, its mean log ratio is more than this below that of the
poses that are searched (nats)."""
SAME_POSE_M, SAME_POSE_RAD = 0.75, math.radians(5.0)
"""Chosen: poses closer to each other than this are the same."""


def rivals_of(found: Found, known: Sequence[Found], trial: Trial) -> list[Found]:
    """Poses other than `found` that may lower its odds below those asked: shifts along its weak direction, and plans.

    Poses that the prior excludes are rivals, too: a pose that fits no better than wrong ones is not proven by being
    near the prior. `known`: poses that are not searched again.
    """
    free = trial._replace(gate=anywhere)
    least_ratio = trial.table.least_ratio_of_rivals(found.agreement.counts, trial.least_odds)
    passed: list[Found] = []
    for led in _starts(found, free, least_ratio):
        done = [pose.T_target_source for pose in (*known, *passed)]
        if is_near(led.T_target_source, [found.T_target_source], within_m=SAME_POSE_M, within_rad=SAME_POSE_RAD):
            continue
        if is_near(led.T_target_source, done, within_m=EQUAL_M, within_rad=EQUAL_RAD):
            continue
        rival = free.refined(led, led.T_target_source)
        if isinstance(rival, Found):
            passed.append(rival)
    return passed


def differs(pose: Found, other: Found) -> bool:
    """True unless two poses are so close that they are the same."""
    near = [other.T_target_source]
    return not is_near(pose.T_target_source, near, within_m=SAME_POSE_M, within_rad=SAME_POSE_RAD)


def _starts(found: Found, trial: Trial, least_ratio: float) -> Iterator[Registration]:
    """Poses to which few points lead from shifts along the weak direction, and from floor plans."""
    weakest = refinement.weakest_level(found.fine.information)
    for sign in (-1.0, 1.0):
        yield from _shifted(found, sign * weakest, trial, least_ratio)
    for coarse in plans_near(trial, num_poses=trial.config.verify.max_rivals):
        led = _led(coarse, found, trial, least_ratio)
        if led is not None:
            yield led


def _led(coarse: Registration, found: Found, trial: Trial, least_ratio: float) -> Registration | None:
    """Where few points lead; None if the pose is the found one or hopeless, mostly after the first iterations."""
    surfaces = few_points(trial.source, trial.config.refine), trial.target.surface
    if min(map(len, surfaces)) < trial.config.refine.min_points:
        return None
    with trial.watch("refine"):
        T_begun = refinement.approach(*surfaces, coarse.T_target_source, config=trial.config.refine)
    if is_near(T_begun, [found.T_target_source], within_m=SAME_POSE_M, within_rad=SAME_POSE_RAD):
        return replace(coarse, T_target_source=T_begun)
    if trial.first_ratio(T_begun) < least_ratio - APPROACH_RATIO:
        return None
    with trial.watch("refine"):
        fine = refinement.refine(*surfaces, T_begun, config=trial.config.refine, must_converge=False)
    if isinstance(fine, Rejected) or trial.first_ratio(fine.T_target_source) < least_ratio - FEW_RATIO:
        return None
    return replace(coarse, T_target_source=fine.T_target_source)


def _shifted(found: Found, direction: Direction, trial: Trial, least_ratio: float) -> Iterator[Registration]:
    """Poses led to from shifts in one direction, the farthest first.

    Shifts between the start and the end of a refinement are not tried: they would lead to the same pose.
    """
    nearest_m, T_found = math.inf, found.T_target_source
    for shift_m in range(MOST_SHIFT_M, 0, -1):
        if shift_m >= nearest_m:
            continue
        T_shifted: Transform = T_found @ geometry.transform(np.eye(3), shift_m * direction)
        led = _led(replace(found.fine, T_target_source=T_shifted), found, trial, least_ratio)
        if led is not None:
            yield led
            nearest_m = float((geometry.inverse(T_found) @ led.T_target_source)[:3, 3] @ direction)
