"""Rivals: other poses that may explain the two scans as well as one that was found."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.types import Direction, Registration, Rejected, Transform
from segslam.registration import refinement
from segslam.verification import score
from segslam.verification.trial import Found, Trial, anywhere, few_points

MOST_SHIFT_M = 8
"""Chosen: largest shift along the weak direction at which rivals are searched, in steps of 1 m; refinement finds rivals
within 0.5 m."""
FEW_LEAD, APPROACH_LEAD = 2.0, 4.0
"""Chosen: a rival is dropped if the found pose, by the patches of the source, leads by so many standard deviations more
than matters, after a refinement with few points and after its first iterations."""
MOST_RIVALS = 4
"""Chosen: number of rivals that are refined with all points, those over which the found pose leads least."""


def rivals_of(found: Found, known: Sequence[Found], trial: Trial) -> list[Found]:
    """Poses other than `found` that may lower its odds below those asked: shifts along its weak direction, and plans.

    Poses that the prior excludes are rivals, too: a pose that fits no better than wrong ones is not proven by being
    near the prior. `known`: poses that are not searched again.
    """
    free = trial._replace(gate=anywhere)
    done = [pose.T_target_source for pose in known]
    starts: list[_Start] = []
    for start in sorted(_starts(found, free), key=lambda start: start.lead):
        if not refinement.is_near(start.coarse.T_target_source, done):
            done.append(start.coarse.T_target_source)
            starts.append(start)
    refined = [  # where the scans let a pose slide, a rival need not converge to fit as well
        free.refined(start.coarse, start.coarse.T_target_source, must_converge=False) for start in starts[:MOST_RIVALS]
    ]
    return [rival for rival in refined if isinstance(rival, Found)]


class _Start(NamedTuple):
    """A pose to which few points lead."""

    coarse: Registration
    lead: float
    """Of the found pose over this one, by the patches of the source."""


def _starts(found: Found, trial: Trial) -> list[_Start]:
    """Poses to which few points lead from shifts along the weak direction, and from floor plans."""
    weakest = refinement.weakest_level(found.fine.information)
    shifted = [start for sign in (-1.0, 1.0) for start in _shifted(found, sign * weakest, trial)]
    plans = [_led(coarse, found, trial) for coarse in trial.plans_near()]
    return [
        start
        for start in (*shifted, *plans)
        if start is not None and not refinement.is_near(start.coarse.T_target_source, [found.T_target_source])
    ]


def _led(coarse: Registration, found: Found, trial: Trial) -> _Start | None:
    """Where few points lead; None if the pose is hopeless, mostly after the first iterations."""
    surfaces = few_points(trial.source), trial.target.surface
    with trial.watch("refine"):
        T_begun = refinement.approach(*surfaces, coarse.T_target_source, config=trial.config.refine)
    if refinement.is_near(T_begun, [found.T_target_source]):
        return _Start(replace(coarse, T_target_source=T_begun), 0.0)
    most = score.shipped().most_lead(found.agreement.counts, trial.least_odds)
    if _lead(found, T_begun, trial) > most + APPROACH_LEAD:
        return None
    fine = trial.led(T_begun)
    if isinstance(fine, Rejected):
        return None
    lead = _lead(found, fine.T_target_source, trial)
    return None if lead > most + FEW_LEAD else _Start(replace(coarse, T_target_source=fine.T_target_source), lead)


def _lead(found: Found, T_target_source: Transform, trial: Trial) -> float:
    """Lead of the found pose over another, by the patches of the source."""
    shown = trial.first_look(T_target_source)
    return score.paired_lead(score.shipped().ratios, [(found.agreement.of_source, shown)])


def _shifted(found: Found, direction: Direction, trial: Trial) -> Iterator[_Start]:
    """Poses led to from shifts in one direction, the farthest first.

    Shifts between the start and the end of a refinement are not tried: they would lead to the same pose.
    """
    nearest_m, T_found = math.inf, found.T_target_source
    for shift_m in range(MOST_SHIFT_M, 0, -1):
        if shift_m >= nearest_m:
            continue
        T_shifted: Transform = T_found @ geometry.transform(np.eye(3), shift_m * direction)
        start = _led(replace(found.fine, T_target_source=T_shifted), found, trial)
        if start is not None:
            yield start
            nearest_m = float((geometry.inverse(T_found) @ start.coarse.T_target_source)[:3, 3] @ direction)
