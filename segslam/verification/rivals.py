"""Rivals: other poses that fit the two scans almost as well, which make a pose ambiguous."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.threads import at_once
from segslam.core.types import Alignment, Direction, Registration, Rejected, RejectReason, Transform
from segslam.registration import refinement
from segslam.registration.hypotheses import anywhere, plans_near
from segslam.registration.refinement import MIN_POINTS
from segslam.verification import gates
from segslam.verification.trial import EQUAL_M, EQUAL_RAD, Found, Trial, few_points, is_near

MOST_SHIFT_M = 8
"""Chosen: largest shift along the weak direction at which rivals are searched, in steps of 1 m; refinement finds rivals
within 0.5 m."""
SPARSE_MARGIN = 1.15
"""Chosen: a rival is refined with all points if its mismatch after refinement with few is at most so many times the
largest that makes a pose ambiguous. The 7 rivals that made a pose ambiguous in scenes of even seeds had up to 1.06."""
HOPELESS = 1.2
"""Chosen: a pose is dropped if, after the first iterations, its mismatch is more than so many times the largest of the
poses that are searched. Of 46 rivals in streets, corridors, tunnels, garages and forests none had more than 1.14; nine
of ten other poses had more."""
SAME_POSE_M, SAME_POSE_RAD = 0.75, math.radians(5.0)
"""Chosen: poses closer to each other than this are the same."""


class Searched(NamedTuple):
    """Which poses are searched."""

    most: float
    """Largest mismatch."""
    found: tuple[Found, ...] = ()
    """Poses that are not searched again."""


def unless_ambiguous(found: Found, trial: Trial) -> Alignment | Rejected:
    """The best of a pose and its rivals; AMBIGUOUS if a different pose fits almost as well.

    Rivals are searched if the scans constrain the pose badly in some direction, as along a tunnel, or fit less well
    than neighbouring keyframes do. In the second case poses that the prior excludes are rivals too: a pose that fits
    no better than wrong ones is not proven by being near the prior. A pose that violates free space is dropped if one
    that fits about as well does not.
    """
    config = trial.config.verify
    certain = gates.is_certain(found.agreement, trial.floor)
    if certain and found.alignment.observability >= config.well_observed:
        return found.alignment
    loose = trial._replace(limits=trial.limits.loosened(), gate=trial.gate if certain else anywhere, is_rival=True)
    passed = [found]
    most = SPARSE_MARGIN * config.rival_ratio * found.agreement.mismatch
    tried: list[Transform] = []
    for led in _rivals(found, loose, Searched(most, (found,))):
        T_led = led.T_target_source
        if _is_near(T_led, passed) or is_near(T_led, tried, within_m=EQUAL_M, within_rad=EQUAL_RAD):
            continue
        tried.append(T_led)
        if loose.mismatch(T_led) <= most and loose.rejection_of_few(T_led) is None:
            rival = loose.refined(led, T_led)
            if isinstance(rival, Found) and not _is_near(rival.alignment.fine.T_target_source, passed):
                passed.append(rival)
    best, *others = _almost_as_good(passed, trial)
    if others:
        apart = geometry.inverse(best.alignment.fine.T_target_source) @ others[0].alignment.fine.T_target_source
        beside = f"{others[0].agreement.mismatch:.3f} {geometry.distance(apart):.1f} m off"
        return Rejected(RejectReason.AMBIGUOUS, f"mismatch {best.agreement.mismatch:.3f}, and {beside}")
    rejected = trial.gate(best.alignment.fine.T_target_source, slack_m=0.0)
    if rejected is None:
        rejected = trial.rejection(best)
    return best.alignment if rejected is None else rejected


def _almost_as_good(passed: Sequence[Found], trial: Trial) -> list[Found]:
    """The poses that fit best or almost as well, best first, without those that another of them contradicts."""
    ranked = sorted(passed, key=lambda one: one.agreement.mismatch)
    most = trial.config.verify.rival_ratio * ranked[0].agreement.mismatch
    close = [one for one in ranked if one is ranked[0] or one.agreement.mismatch < most]
    agreed = [one.agreement for one in close]
    return [one for one in close if not any(gates.contradicts(other, one.agreement, trial.floor) for other in agreed)]


def _rivals(found: Found, trial: Trial, searched: Searched) -> list[Registration]:
    """Other poses that may fit as well, refined with a few points: shifts along the weak direction, and floor plans."""

    def lead(coarse: Registration) -> Registration | None:
        return sparsely_refined(trial, coarse, searched)

    def along() -> list[Registration]:
        ways = (sign * found.weak_direction for sign in (-1.0, 1.0))
        return [led for way in ways for led in _shifted(found.alignment.fine, way, lead)]

    def from_plans() -> list[Registration]:
        plans = plans_near(trial.pair, num_poses=trial.config.verify.max_rivals)
        leds = [lead(coarse) for coarse in plans if not _is_near(coarse.T_target_source, [found])]
        return [led for led in leds if led is not None]

    shifted, planned = at_once(along, from_plans)
    return shifted + planned


def sparsely_refined(trial: Trial, coarse: Registration, searched: Searched) -> Registration | None:
    """A pose refined with a few points of the source; None if it is impossible or fits badly.

    The first iterations show whether the pose fits badly, and whether it is one of those found.
    """
    if trial.gate(coarse.T_target_source, slack_m=trial.config.verify.max_coarse_fine_m) is not None:
        return None
    few = few_points(trial.source, trial.config.refine)
    if min(map(len, (few.surface, trial.target.surface))) < MIN_POINTS:
        return None
    if trial.free_space_rejection(coarse.T_target_source) is not None:
        return None
    surfaces = few.surface, trial.target.surface
    with trial.watch("refine"):
        T_begun = refinement.approach(*surfaces, coarse.T_target_source, config=trial.config.refine)
        if _is_near(T_begun, searched.found):
            return replace(coarse, T_target_source=T_begun)
    if trial.rejection_of_few(T_begun, most=HOPELESS * searched.most) is not None:
        return None
    with trial.watch("refine"):
        fine = refinement.refine(*surfaces, T_begun, config=trial.config.refine, must_converge=False)
    return None if isinstance(fine, Rejected) else replace(coarse, T_target_source=fine.T_target_source)


def _shifted(
    pose: Registration, direction: Direction, lead: Callable[[Registration], Registration | None]
) -> Iterator[Registration]:
    """Poses refined (by `lead`) from shifts in one direction, the farthest first.

    Shifts between the start and the end of a refinement are not tried: they would lead to the same pose.
    """
    nearest_m = math.inf
    for shift_m in range(MOST_SHIFT_M, 0, -1):
        if shift_m >= nearest_m:
            continue
        T_shifted = pose.T_target_source @ geometry.transform(np.eye(3), shift_m * direction)
        led = lead(replace(pose, T_target_source=T_shifted))
        if led is not None:
            yield led
            nearest_m = float((geometry.inverse(pose.T_target_source) @ led.T_target_source)[:3, 3] @ direction)


def _is_near(T_target_source: Transform, others: Sequence[Found]) -> bool:
    """True if a pose is so close to one of the others that refinement would lead to it."""
    poses = [other.alignment.fine.T_target_source for other in others]
    return is_near(T_target_source, poses, within_m=SAME_POSE_M, within_rad=SAME_POSE_RAD)
