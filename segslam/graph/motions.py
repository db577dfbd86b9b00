"""Motions of odometry that closures contradict: rejected like closures, at a higher cost.

If odometry jumps between two keyframes, all closures across the jump measure the same drift, and they do not fit the
rest of the drive unless that motion is rejected. A group of rejected closures that are consistent with each other is
therefore explained by a jump at one motion that all of them span, and the drive is optimised without that motion. The
result is used if its truncated cost, in which the motion has a penalty, is lower.

One place is never enough: its closures may all have the same error, as in a repeated street, and their penalties sum up
to less than that of a motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import NamedTuple

import gtsam
import numpy as np

from segslam.core import geometry
from segslam.core.types import Mask, Transform, Vector
from segslam.graph import noise
from segslam.graph.closure_pairs import Pairs, consistent_pairs, largest_consistent
from segslam.graph.edges import Edge, Transforms, factor_graph, joined, poses_by_id, values_of
from segslam.graph.gnc import Solution, TruncatedProblem
from segslam.graph.selection import MIN_GROUP, select_consistent

MOTION_PENALTY = 2.5
"""Cost of rejecting a motion, in rejected closures. Chosen: above the 2 of one place, below the 3 of a revisit of 60 m
with a closure each 12 m."""
MAX_TRIALS = 10
"""Chosen: largest number of rejected motions; drives with more need a better odometry."""
TURN_M = 5.0
"""Distance equivalent to a rotation by one radian in comparisons of motions (m). Chosen: `GraphConfig.turn_m`."""


@dataclass(frozen=True, slots=True, eq=False)
class Constants:
    """The constant data of the problem while motions are rejected."""

    prior: gtsam.NonlinearFactorGraph
    closures: list[Edge]
    penalties: Vector
    near: Pairs
    """(k, k) True for closures that join the same places."""
    inlier_bound: float
    strict_bound: float
    """Chi-square within which closures of a group are consistent: errors as claimed, without an allowance."""

    def problem(self, odometry: Sequence[Edge]) -> TruncatedProblem:
        """The truncated least-squares problem with this odometry."""
        backbone = joined(self.prior, factor_graph(odometry))
        return TruncatedProblem(backbone, self.closures, self.inlier_bound, penalties=self.penalties)

    def solve(self, odometry: Sequence[Edge], start: gtsam.Values) -> Solution:
        """Poses and inliers near `start` and near consistent sets of closures."""
        consistent = consistent_pairs(odometry, self.closures, self.inlier_bound)
        return select_consistent(self.problem(odometry), start, consistent, self.near)


class MotionSolution(NamedTuple):
    """A solution and the motions that it rejects (n - 1,)."""

    solution: Solution
    rejected: Mask

    def cost(self, inlier_bound: float) -> float:
        """Truncated cost, with the penalties of motions."""
        return self.solution.truncated_cost + 0.5 * inlier_bound * MOTION_PENALTY * int(self.rejected.sum())


def without(odometry: Sequence[Edge], rejected: Mask) -> list[Edge]:
    """Odometry in which rejected motions have next to no information."""
    return [
        replace(edge, information=noise.UNKNOWN_MOTION) if out else edge
        for edge, out in zip(odometry, rejected, strict=True)
    ]


def solve(drive: Constants, odometry: Sequence[Edge], start: gtsam.Values, rejected: Mask) -> MotionSolution:
    """The best solution near `start`, where motions that were rejected before are rejected again or restored."""
    none = np.zeros(len(odometry), dtype=bool)
    found = _reject(drive, odometry, MotionSolution(drive.solve(odometry, start), none))
    if not rejected.any():
        return found
    kept = without(odometry, rejected)
    again = _reject(drive, kept, MotionSolution(drive.solve(kept, start), rejected))
    return min(again, found, key=lambda each: each.cost(drive.inlier_bound))


def _reject(drive: Constants, odometry: Sequence[Edge], best: MotionSolution) -> MotionSolution:
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
            consistent = consistent_pairs(odometry, drive.closures, drive.strict_bound)
        group = largest_consistent(consistent, left)
        if group.sum() < MIN_GROUP or drive.penalties[group].sum() <= MOTION_PENALTY:
            break
        left = left & ~group
        jump = _jump(drive, odometry, group, best.solution.weights)
        if jump is None:
            continue
        trial_odometry = [*odometry[: jump.a], jump, *odometry[jump.b :]]
        start = values_of(_bent(poses_by_id(best.solution.search.values), jump))
        rejected = best.rejected.copy()
        rejected[jump.a] = True
        trial = MotionSolution(drive.solve(trial_odometry, start), rejected)
        if trial.cost(drive.inlier_bound) < best.cost(drive.inlier_bound):
            best, consistent, left = trial, None, trial.solution.weights == 0.0
            T_world_a, T_world_b = poses_by_id(trial.solution.search.values)[jump.a : jump.b + 1]
            odometry[jump.a] = replace(jump, T_a_b=geometry.inverse(T_world_a) @ T_world_b)
    return best


def _bent(T_world: Transforms, motion: Edge) -> Transforms:
    """The poses with another motion between two keyframes; all later ones move along."""
    T_new_old = T_world[motion.a] @ motion.T_a_b @ geometry.inverse(T_world[motion.b])
    return np.concatenate([T_world[: motion.b], T_new_old @ T_world[motion.b :]])


def _jump(drive: Constants, odometry: Sequence[Edge], group: Mask, weights: Vector) -> Edge | None:
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
    T_world = np.array(list(accumulate((edge.T_a_b for edge in odometry), np.matmul, initial=np.eye(4))))
    T_drift = _drift(drive.closures[np.flatnonzero(group)[group.sum() // 2]], T_world)
    corrected = np.linalg.inv(T_world[rows]) @ T_drift @ T_world[rows + 1]
    gains = [
        _roughness(odometry, row, odometry[row].T_a_b) - _roughness(odometry, row, T_a_b)
        for row, T_a_b in zip(rows.tolist(), corrected, strict=True)
    ]
    best = int(np.argmax(gains))
    row = int(rows[best])
    return Edge(row, row + 1, corrected[best], noise.UNKNOWN_MOTION)


def _drift(closure: Edge, T_world: Transforms) -> Transform:
    """The transform, in the world frame, by which the jump moved all later poses."""
    T_drift = T_world[closure.a] @ closure.T_a_b @ geometry.inverse(T_world[closure.b])
    return T_drift if closure.a < closure.b else geometry.inverse(T_drift)


def _roughness(odometry: Sequence[Edge], row: int, T_a_b: Transform) -> float:
    """Difference of a motion from the motions before and after it (m)."""
    around = [odometry[k].T_a_b for k in (row - 1, row + 1) if 0 <= k < len(odometry)]
    apart = [geometry.inverse(T_other) @ T_a_b for T_other in around]
    return sum(geometry.distance(T) + TURN_M * geometry.angle(T) for T in apart)
