"""Joint solution of a finished graph and the fixes, with a weight that the fixes themselves justify.

With the noise of the largest likelihood (`evidence`), a receiver with slow errors hardly bends a consistent map. But a
map may have systematic errors that its graph does not claim, and a good receiver is then right: held-out windows of
fixes decide by a paired t-test (docs/gnss.md). Between fixes that are near every bent drive predicts well, so a window
is as long as the longest part of the drive without fixes.
"""

from collections.abc import Sequence

import numpy as np

from segslam.core.probabilities import SIGNIFICANT, sigmas_beyond
from segslam.core.trajectory import Poses, travelled_m
from segslam.core.types import Mask, Points, SegslamError, Vector
from segslam.gnss.alignment import Placement, antennas, moved, refined
from segslam.gnss.evidence import Estimate, estimated
from segslam.gnss.matching import Prepared
from segslam.gnss.statistics import KEPT_WEIGHT, Weights, axis_sigma, robust_weights, sigmas
from segslam.graph.position_fixes import PositionedGraph

NUM_WINDOWS = 6
"""Chosen: windows of fixes in a row that are held out, one at a time; a sixth of the fixes is longer than the errors of
most receivers are correlated. Longer windows overlap."""
MOST_HELD_OUT = 0.5
"""Chosen: largest share of the fixes in a window; the others place the drive."""
SIGNIFICANT_T = 1.476
"""Derived: Student's t with 5 degrees of freedom, one-sided, at 10 %: for six windows."""
RIGID_M = 1000.0
"""Standard deviation of fixes that do not bend the drive."""
LEAST_FUSED = 24
"""Chosen: with fewer fixes, four a window, the drive keeps its shape."""
ROUNDS = 4
"""Chosen: iterations of weights and poses; they settle in three."""
SIGNIFICANT_SIGMAS = sigmas_beyond(SIGNIFICANT)
"""The clock and the lever arm are corrected beyond this many standard deviations."""
CONSTANT_ROUNDS = 3
"""Chosen: repetitions of placement and constants; the third changes the lever arm by less than its noise."""


def calibrate(
    graph: PositionedGraph, prepared: Prepared, placement: Placement, *, offset_s: float
) -> tuple[Placement, float, Estimate]:
    """The placement with the clock and the lever arm of the receiver where they are significant.

    Also the seconds added to the times of the fixes beyond `offset_s`, 0 if not significant, and the horizontal noise.
    """
    arm_m, measured_s = np.zeros(3), 0.0
    clock_free = arm_free = True
    for _ in range(CONSTANT_ROUNDS):
        if not (placement.weights[:, 0] >= KEPT_WEIGHT).any():
            raise SegslamError(
                f"{prepared.fixes.source}: the fixes contradict each other, and none is kept; use better ones"
            )
        found = estimated(graph, placement, axis=0, free=(clock_free, arm_free))
        clock, arm = found.constants[6], found.constants[7:9]
        total_s, total_m = abs(measured_s + clock), np.abs(arm_m[:2] + arm)
        clock_free = clock_free and bool(total_s > SIGNIFICANT_SIGMAS * found.constant_sigma[6])
        arm_free = arm_free and bool((total_m > SIGNIFICANT_SIGMAS * found.constant_sigma[7:9]).any())
        measured_s = measured_s + float(clock) if clock_free else 0.0
        arm_m = arm_m + np.array([*arm, 0.0]) if arm_free else np.zeros(3)
        start = moved(placement.T_enu_map, found.constants[:6])
        placement = refined(prepared.matched(offset_s + measured_s), start, arm_m)
    return placement, measured_s, found


def fuse(
    graph: PositionedGraph, placement: Placement, level: Estimate
) -> tuple[Poses, Weights, Vector, tuple[bool, bool]]:
    """Bend the placed drive by its fixes as far as they are better than it; `level`: the horizontal noise.

    Returns the poses (k, 4, 4) of the keyframes in the local frame, the robust weights (n, 2) of the fixes, the
    standard deviations (3,) of single fixes about the drive, and whether it is bent horizontally and in height.
    Raises Unsolvable.
    """
    interval_s = float(np.median(np.diff(placement.matched.time_s)))
    noises = [level]
    if np.sum(placement.weights[:, 1] >= KEPT_WEIGHT) >= NUM_WINDOWS:
        noises.append(estimated(graph, placement, axis=1))
    sigma = np.full(3, RIGID_M)  # with which the fixes act
    for axis, noise in enumerate(noises if len(placement.matched) >= LEAST_FUSED else []):
        is_of_axis = np.array([axis == 0, axis == 0, axis == 1])
        stiffnesses = (RIGID_M, noise.effective_sigma_m(interval_s), noise.white_m)
        sigma = _best(graph, placement, [np.where(is_of_axis, one, sigma) for one in stiffnesses], axis)
    T, weights, _ = _solved(graph, placement, sigma)
    return (
        T,
        weights,
        sigmas(placement.residual(T), *(weights >= KEPT_WEIGHT).T),
        (bool(sigma[0] < RIGID_M), bool(sigma[2] < RIGID_M)),
    )


def _best(graph: PositionedGraph, placement: Placement, candidates: Sequence[Vector], axis: int) -> Vector:
    """The stiffest of three candidates, rigid, soft and close, whose cost is not significantly above the least one."""
    reference = placement.residual(placement.T_enu_keyframe)
    windows = _windows(placement, placement.weights[:, axis] >= KEPT_WEIGHT)
    known = reference[np.isfinite(_along(reference, axis))]
    scale = axis_sigma(known[:, 2] if axis else known)
    costs = np.array([_held_out(graph, placement, one, windows, axis, scale) for one in candidates])
    means = costs.mean(axis=1)
    more = costs - costs[means.argmin()]
    is_as_good = more.mean(axis=1) <= SIGNIFICANT_T * more.std(axis=1, ddof=1) / np.sqrt(NUM_WINDOWS)
    return candidates[int(is_as_good.argmax())]


def _windows(placement: Placement, used: Mask) -> list[slice]:
    """Fixes in a row to hold out, spread over the drive; each window is as long as the largest gap between used fixes.

    The gap is a share of the travel, with the fixes that remain as the whole.
    """
    total_m = float(travelled_m(placement.matched.drive.T_map_lidar)[-1])
    gaps_m = np.diff([0.0, *placement.matched.travel_m[used], total_m])
    gap = min(float(gaps_m.max()) / max(total_m, 1e-9), MOST_HELD_OUT)
    share = float(np.clip(gap / (1.0 - gap), 1.0 / NUM_WINDOWS, MOST_HELD_OUT))
    n = len(used)
    size = int(n * share)
    return [slice(first, first + size) for first in np.linspace(0, n - size, NUM_WINDOWS).astype(int).tolist()]


def _held_out(
    graph: PositionedGraph, placement: Placement, sigma: Vector, windows: Sequence[slice], axis: int, scale: float
) -> Vector:
    """(w,) mean cost of the fixes of each window about the drive that was solved without them.

    In units of `scale`, the standard deviation about the placed drive; far ones count little more.
    """
    T, _, precisions = _solved(graph, placement, sigma)
    costs = []
    for window in windows:
        without = precisions.copy()
        without[window] = 0.0
        T_without = _solve(graph, placement, T, without) if without.any() else placement.T_enu_keyframe
        values = _along(placement.residual(T_without)[window], axis)
        known = values[np.isfinite(values)]
        costs.append(float(np.mean(np.log1p(known**2 / scale**2))) if len(known) else 0.0)
    return np.array(costs)


def _solved(graph: PositionedGraph, placement: Placement, sigma: Vector) -> tuple[Poses, Weights, Points]:
    """Poses, weights (n, 2) and precisions (n, 3) by reweighted least squares, at first of the consistent fixes."""
    T, weights = placement.T_enu_keyframe, placement.weights
    for _ in range(ROUNDS):
        precisions = weights.take([0, 0, 1], axis=1) / sigma**2
        T = _solve(graph, placement, T, precisions)
        residual = placement.residual(T)
        weights = robust_weights(residual, sigmas(residual, *(weights >= KEPT_WEIGHT).T), placement.matched.time_s)
    return T, weights, precisions


def _solve(graph: PositionedGraph, placement: Placement, start: Poses, precisions: Points) -> Poses:
    matched = placement.matched
    points = antennas(matched.T_keyframe_lidar, placement.arm_m)
    return graph.solve(start, matched.keyframe, points, matched.enu_m, precisions)


def _along(residual: Points, axis: int) -> Vector:
    """(n,) horizontal lengths for axis 0, heights for axis 1."""
    return residual[:, 2] if axis else np.hypot(*residual[:, :2].T)
