"""The final optimisation of a drive: which closures are inliers, and which motions of odometry are not.

If odometry jumps between two keyframes, all closures across the jump measure the same drift, and they do not fit the
rest of the drive unless that motion is rejected. A group of rejected closures that are consistent with each other is
therefore explained by a jump at one motion that all of them span, and the drive is optimised without that motion. The
result is used if its truncated cost, in which the motion has a penalty, is lower.

One place is never enough: its closures may all have the same error, as in a repeated street, and their penalties sum up
to less than that of a motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np

from segslam.core import geometry
from segslam.core.types import Mask, Transform, Vector
from segslam.graph import gnc, noise
from segslam.graph.closure_pairs import MAX_PAIRED, Pairs, consistent_pairs, largest_consistent, neighbours, num_near
from segslam.graph.edges import Edge, chained, factor_graph, joined, poses_by_id, values_of
from segslam.graph.gnc import MIN_GROUP, select_consistent

PLACE_M = 30.0
"""Closures whose ends are this near in travel join the same two places: they may be wrong together, and registrations
that wait confirm each other. Chosen."""
PLACE_PENALTY = 2.0
"""Closures joining the same two places are correlated; together they weigh at most as much as this many independent
ones. Chosen from 0.5 to 5 with `tools/benchmarks/back_end`: below, correct closures are rejected; above, a repeated
street outweighs odometry."""
MOTION_PENALTY = 2.5
"""Cost of rejecting a motion, in rejected closures. Chosen: above the 2 of one place, below the 3 of a revisit of 60 m
with a closure each 12 m."""
MAX_TRIALS = 10
"""Chosen: largest number of rejected motions; drives with more need a better odometry."""


@dataclass(frozen=True, eq=False)
class Drive:
    """The constant data of the problem while motions are rejected."""

    prior: gtsam.NonlinearFactorGraph
    """The factor of the first pose."""
    closures: list[Edge]
    travel_m: Vector
    inlier_bound: float
    """Chi-square of an inlier, with the allowance for errors larger than claimed."""

    @cached_property
    def penalties(self) -> Vector:
        """(k,) cost of rejecting each closure."""
        return np.minimum(1.0, PLACE_PENALTY / num_near(self.closures, self.travel_m, PLACE_M))

    @cached_property
    def near(self) -> Pairs:
        """(k, k) True for closures that join the same places."""
        return neighbours(self.closures, self.travel_m, PLACE_M)

    def problem(self, odometry: Sequence[Edge]) -> gnc.TruncatedProblem:
        """The truncated least-squares problem with this odometry."""
        backbone = joined(self.prior, factor_graph(odometry))
        return gnc.TruncatedProblem(backbone, self.closures, self.inlier_bound, self.penalties)

    def solve(self, odometry: Sequence[Edge], start: gtsam.Values, rejected: Mask) -> "MotionSolution":
        """Poses and inliers near `start` and near consistent sets of closures; this odometry is without `rejected`."""
        consistent = consistent_pairs(odometry, self.closures, self.inlier_bound)
        solution = select_consistent(self.problem(odometry), start, consistent, self.near)
        penalty = 0.5 * self.inlier_bound * MOTION_PENALTY * int(rejected.sum())
        return MotionSolution(solution, rejected, solution.truncated_cost + penalty)


class MotionSolution(NamedTuple):
    """A solution, the motions that it rejects (n - 1,), and its truncated cost with their penalties."""

    solution: gnc.Solution
    rejected: Mask
    cost: float


def without(odometry: Sequence[Edge], rejected: Mask | Sequence[bool]) -> list[Edge]:
    """Odometry in which rejected motions have next to no information."""
    return [
        replace(edge, information=noise.UNKNOWN_MOTION) if out else edge
        for edge, out in zip(odometry, rejected, strict=True)
    ]


def solve_final(
    drive: Drive, odometry: Sequence[Edge], start: gtsam.Values, rejected: Mask, *, pairwise: bool
) -> MotionSolution:
    """Poses and inliers near `start` or the largest pairwise-consistent set.

    Motions that were `rejected` before are rejected again or restored. Unless `pairwise`, and for too many closures,
    graduated non-convexity selects, and all motions are kept.
    """
    none = np.zeros(len(odometry), dtype=bool)
    if not pairwise or len(drive.closures) > MAX_PAIRED:
        solution = gnc.solve(drive.problem(odometry), start)
        return MotionSolution(solution, none, solution.truncated_cost)
    found = _reject(drive, odometry, drive.solve(odometry, start, none))
    if not rejected.any():
        return found
    kept = without(odometry, rejected)
    return min(_reject(drive, kept, drive.solve(kept, start, rejected)), found, key=lambda each: each.cost)


def _reject(drive: Drive, odometry: Sequence[Edge], best: MotionSolution) -> MotionSolution:
    """The solution without the motions that groups of rejected closures contradict.

    Without such a group the solution stays as it is.
    """
    odometry = list(odometry)
    left = best.solution.weights == 0.0
    consistent: Pairs | None = None
    for _ in range(MAX_TRIALS):
        if drive.penalties[left].sum() <= MOTION_PENALTY:
            break
        if consistent is None:
            consistent = consistent_pairs(odometry, drive.closures, noise.inlier_bound())
        group = largest_consistent(consistent, left)
        if group.sum() < MIN_GROUP or drive.penalties[group].sum() <= MOTION_PENALTY:
            break
        left = left & ~group
        jump = _jump(drive, odometry, group, best.solution.weights)
        if jump is None:
            continue
        trial_odometry = [*odometry[: jump.a], jump, *odometry[jump.b :]]
        T_world = poses_by_id(best.solution.search.values)
        T_new_old = T_world[jump.a] @ jump.T_a_b @ geometry.inverse(T_world[jump.b])
        bent = np.concatenate([T_world[: jump.b], T_new_old @ T_world[jump.b :]])  # all later poses move along
        rejected = best.rejected.copy()
        rejected[jump.a] = True
        trial = drive.solve(trial_odometry, values_of(bent), rejected)
        if trial.cost < best.cost:
            best, consistent, left = trial, None, trial.solution.weights == 0.0
            T_world_a, T_world_b = poses_by_id(trial.solution.search.values)[jump.a : jump.b + 1]
            odometry[jump.a] = replace(jump, T_a_b=geometry.inverse(T_world_a) @ T_world_b)
    return best


def _jump(drive: Drive, odometry: Sequence[Edge], group: Mask, weights: Vector) -> Edge | None:
    """The motion that a group of closures contradicts, as they measure it; None if rejecting it costs more.

    Only motions that all closures of the group span are possible. Inliers that span a motion contradict the group, so
    it is one where their penalties are least; of these, the one that the change makes most like its neighbours.
    """
    spans = np.sort(np.array([(edge.a, edge.b) for edge in drive.closures]), axis=1)
    first, end = spans[group, 0].max(), spans[group, 1].min()
    if first >= end:
        return None
    steps = np.zeros(len(odometry) + 1)
    np.add.at(steps, spans[:, 0], weights * drive.penalties)
    np.add.at(steps, spans[:, 1], -weights * drive.penalties)
    against = np.cumsum(steps)[first:end]
    if against.min() + MOTION_PENALTY >= drive.penalties[group].sum():
        return None
    rows = first + np.flatnonzero(against <= against.min() + 1e-9)
    T_world = chained(odometry)
    closure = drive.closures[np.flatnonzero(group)[group.sum() // 2]]
    T_drift = T_world[closure.a] @ closure.T_a_b @ geometry.inverse(T_world[closure.b])  # of later poses, by the jump
    T_drift = T_drift if closure.a < closure.b else geometry.inverse(T_drift)
    corrected = np.linalg.inv(T_world[rows]) @ T_drift @ T_world[rows + 1]
    gains = [
        _roughness(odometry, row, odometry[row].T_a_b) - _roughness(odometry, row, T_a_b)
        for row, T_a_b in zip(rows.tolist(), corrected, strict=True)
    ]
    best = int(np.argmax(gains))
    row = int(rows[best])
    return Edge(row, row + 1, corrected[best], noise.UNKNOWN_MOTION)


def _roughness(odometry: Sequence[Edge], row: int, T_a_b: Transform) -> float:
    """Difference of a motion from the motions before and after it (m)."""
    around = [odometry[k].T_a_b for k in (row - 1, row + 1) if 0 <= k < len(odometry)]
    apart = [geometry.inverse(T_other) @ T_a_b for T_other in around]
    return sum(geometry.distance(T) + noise.TURN_M * geometry.angle(T) for T in apart)
