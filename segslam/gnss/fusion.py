"""Joint solution of a finished graph and the fixes, with a weight that the fixes themselves justify.

The noise of drive and receiver is that of the largest likelihood (`evidence`). With it, the fixes of a receiver with
slow errors hardly bend a consistent map. But a map may also have systematic errors that its graph does not claim; then
a good receiver is right. So windows of fixes are held out, and of three stiffnesses (the drive keeps its shape, is bent
by this noise, follows the fixes closely) the stiffest is used that does not predict the held-out fixes significantly
worse than the best one does (paired t-test over the windows). A window is as long as the longest part of the drive
without fixes: the solution is used there, too, and between fixes that are near every bent drive predicts well.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from segslam.core.trajectory import Poses, travelled_m
from segslam.core.types import Mask, Points, Vector
from segslam.gnss.alignment import PRIOR, Placement, linearised, moved, refined
from segslam.gnss.evidence import DriveCovariance, Estimate, Noise, estimated
from segslam.gnss.matching import Drive, Matched, Prepared
from segslam.gnss.statistics import KEPT_WEIGHT, Weights, axis_sigma, fix_noise, horizontal_sigma, robust_weights
from segslam.graph import Edge
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
SIGNIFICANT = 4.0
"""Chosen: the clock and the lever arm are corrected beyond this many standard deviations."""
CONSTANT_ROUNDS = 3
"""Chosen: repetitions of placement and constants; the third changes the lever arm by less than its noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Constants:
    """Placement of the drive with the clock and the lever arm of the receiver."""

    matched: Matched
    placement: Placement
    measured_offset_s: float
    """Seconds added to the times of the fixes, beyond those given; 0 if they are not significant."""
    level: Estimate
    covariance: DriveCovariance


def calibrate(
    edges: Sequence[Edge], drive: Drive, prepared: Prepared, matched: Matched, placement: Placement, *, offset_s: float
) -> Constants:
    """Clock and lever arm, where they are significant, and the placement with them."""
    covariance = DriveCovariance(edges, drive.T_map_keyframe)
    arm_m, measured_s = np.zeros(3), 0.0
    free = np.ones(2, dtype=bool)
    for _ in range(CONSTANT_ROUNDS):
        residual, columns = linearised(drive, matched, placement.T_enu_map, arm_m)
        kept = placement.weights[:, 0] >= KEPT_WEIGHT
        found = estimated(
            covariance,
            placement.T_enu_map @ drive.T_map_keyframe,
            matched.some(kept),
            residual[kept],
            columns[kept],
            PRIOR * np.repeat([True, *free], [6, 1, 2]),
            axes=[0, 1],
            white_m=fix_noise(residual[kept]),
        )
        clock, arm = found.constants[6], found.constants[7:9]
        total = abs(measured_s + clock), np.abs(arm_m[:2] + arm)
        free &= [total[0] > SIGNIFICANT * found.sigma[6], bool((total[1] > SIGNIFICANT * found.sigma[7:9]).any())]
        measured_s = measured_s + float(clock) if free[0] else 0.0
        arm_m = arm_m + np.array([*arm, 0.0]) if free[1] else np.zeros(3)
        matched = prepared.matched(drive, offset_s + measured_s)
        placement = refined(drive, matched, moved(placement.T_enu_map, found.constants[:6]), arm_m)
    return Constants(matched, placement, measured_s, found, covariance)


def fuse(edges: Sequence[Edge], drive: Drive, constants: Constants) -> tuple[Poses, Weights, Vector, tuple[bool, bool]]:
    """Bend the placed drive by its fixes as far as they are better than it. Raises Unsolvable.

    Returns the poses (k, 4, 4) of the keyframes in the local frame, the robust weights (n, 2) of the fixes, the
    standard deviations (3,) of single fixes about the drive, and whether it is bent horizontally and in height.
    """
    matched, placement = constants.matched, constants.placement
    T_start = placement.T_enu_map @ drive.T_map_keyframe
    problem = _Problem(PositionedGraph(edges, drive.T_map_keyframe), matched, placement, T_start)
    interval_s = float(np.median(np.diff(matched.time_s)))
    residual, columns = linearised(drive, matched, placement.T_enu_map, placement.arm_m)
    up: Noise | None = None
    used = placement.weights[:, 1] >= KEPT_WEIGHT
    if used.sum() >= NUM_WINDOWS:
        up = estimated(
            constants.covariance,
            T_start,
            matched.some(used),
            residual[used],
            columns[used],
            PRIOR * np.repeat([True, False], [6, 3]),
            axes=[2],
            white_m=fix_noise(residual[used, 2]),
        ).noise
    level = constants.level.noise
    soft = np.array(
        [*2 * [level.effective_sigma_m(interval_s)], np.inf if up is None else up.effective_sigma_m(interval_s)]
    )
    close = np.array([level.white_m, level.white_m, np.inf if up is None else up.white_m])
    sigma = _chosen(problem, soft, close)
    T, weights, _ = _solved(problem, sigma)
    return T, weights, _scales(problem.residual(T), weights), (bool(sigma[0] < RIGID_M), bool(sigma[2] < RIGID_M))


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    graph: PositionedGraph
    matched: Matched
    placement: Placement
    T_start: Poses

    def residual(self, T: Poses) -> Points:
        return self.matched.enu_m - self.matched.positions(T, self.placement.arm_m)

    def solve(self, start: Poses, precisions: Points) -> Poses:
        points = self.matched.points(self.placement.arm_m)
        return self.graph.solve(start, self.matched.keyframe, points, self.matched.enu_m, precisions)


def _chosen(problem: _Problem, soft: Vector, close: Vector) -> Vector:
    """(3,) standard deviations with which the fixes act."""
    sigma = np.full(3, RIGID_M)
    if len(problem.matched) < LEAST_FUSED:
        return sigma
    level = _best(problem, [np.array([*one[:2], RIGID_M]) for one in (sigma, soft, close)], 0)
    if not np.isfinite(close[2]):
        return level
    return _best(problem, [np.array([*level[:2], one]) for one in (RIGID_M, soft[2], close[2])], 1)


def _best(problem: _Problem, candidates: Sequence[Vector], axis: int) -> Vector:
    """The stiffest of three candidates, rigid, soft and close, whose cost is not significantly above the least one.

    `axis`: 0 horizontally, 1 vertically.
    """
    reference = problem.residual(problem.T_start)
    windows = _windows(problem, problem.placement.weights[:, axis] >= KEPT_WEIGHT)
    known = reference[np.isfinite(_along(reference, axis))]
    scale = axis_sigma(known[:, 2]) if axis else horizontal_sigma(known)
    costs = np.array([_held_out(problem, one, windows, axis, scale) for one in candidates])
    means = costs.mean(axis=1)
    more = costs - costs[means.argmin()]
    is_as_good = more.mean(axis=1) <= SIGNIFICANT_T * more.std(axis=1, ddof=1) / np.sqrt(NUM_WINDOWS)
    return candidates[int(is_as_good.argmax())]


def _windows(problem: _Problem, used: Mask) -> list[slice]:
    """Fixes in a row to hold out, spread over the drive; each window is as long as the largest gap between used fixes.

    The gap is a share of the travel, with the fixes that remain as the whole.
    """
    total_m = float(travelled_m(problem.T_start)[-1])
    gaps_m = np.diff([0.0, *problem.matched.travel_m[used], total_m])
    gap = min(float(gaps_m.max()) / max(total_m, 1e-9), MOST_HELD_OUT)
    share = float(np.clip(gap / (1.0 - gap), 1.0 / NUM_WINDOWS, MOST_HELD_OUT))
    n = len(used)
    size = int(n * share)
    return [slice(first, first + size) for first in np.linspace(0, n - size, NUM_WINDOWS).astype(int).tolist()]


def _held_out(problem: _Problem, sigma: Vector, windows: Sequence[slice], axis: int, scale: float) -> Vector:
    """(w,) mean cost of the fixes of each window about the drive that was solved without them.

    In units of `scale`, the standard deviation about the placed drive; far ones count little more.
    """
    T, _, precisions = _solved(problem, sigma)
    costs = []
    for window in windows:
        without = precisions.copy()
        without[window] = 0.0
        T_without = problem.solve(T, without) if without.any() else problem.T_start
        values = _along(problem.residual(T_without)[window], axis)
        known = values[np.isfinite(values)]
        costs.append(float(np.mean(np.log1p(known**2 / scale**2))) if len(known) else 0.0)
    return np.array(costs)


def _solved(problem: _Problem, sigma: Vector) -> tuple[Poses, Weights, Points]:
    """Poses, weights (n, 2) and precisions (n, 3) by iteratively reweighted least squares.

    It starts from the largest chain of consistent fixes; later rounds weight all fixes by their residuals.
    """
    T, weights = problem.T_start, problem.placement.weights
    for _ in range(ROUNDS):
        precisions = np.column_stack([weights[:, 0], weights[:, 0], weights[:, 1]]) / sigma**2
        T = problem.solve(T, precisions)
        residual = problem.residual(T)
        weights = robust_weights(residual, _scales(residual, weights), problem.matched.time_s)
    return T, weights, precisions


def _scales(residual: Points, weights: Weights) -> Vector:
    used, used_up = weights[:, 0] >= KEPT_WEIGHT, weights[:, 1] >= KEPT_WEIGHT
    level = horizontal_sigma(residual[used] if used.any() else residual)
    return np.array([level, level, axis_sigma(residual[used_up, 2]) if used_up.any() else np.inf])


def _along(residual: Points, axis: int) -> Vector:
    """(n,) horizontal lengths for axis 0, heights for axis 1."""
    return residual[:, 2] if axis else np.hypot(*residual[:, :2].T)
