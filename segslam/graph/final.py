"""The final optimisation of a drive: which closures are inliers, and which motions of odometry are not."""

from dataclasses import dataclass

import gtsam
import numpy as np

from segslam.core.types import Mask, Vector
from segslam.graph import gnc
from segslam.graph.closure_pairs import ends_m, neighbours, num_near
from segslam.graph.edges import Edge, factor_graph, joined
from segslam.graph.motions import Constants, MotionSolution, solve

MAX_PAIRED = 5_000
"""Largest number of closures compared pairwise (10 s, 450 MB); for more, graduated non-convexity selects."""
PLACE_M = 30.0
"""Closures whose ends are this near in travel join the same two places, and may be wrong together. Chosen."""
PLACE_PENALTY = 2.0
"""Closures joining the same two places are correlated; together they weigh at most as much as this many independent
ones. Chosen from 0.5 to 5 with `tools/benchmarks/back_end`: below, correct closures are rejected; above, a repeated
street outweighs odometry."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """All measurements of a drive."""

    prior: gtsam.NonlinearFactorGraph
    """The factor of the first pose."""
    odometry: list[Edge]
    closures: list[Edge]
    travel_m: Vector
    inlier_bound: float
    """Chi-square of an inlier, with the allowance for errors larger than claimed."""
    claimed_bound: float
    """The same without the allowance."""

    def penalties(self) -> Vector:
        """(k,) cost of rejecting each closure."""
        return np.minimum(1.0, PLACE_PENALTY / num_near(ends_m(self.closures, self.travel_m), PLACE_M))


def solve_gnc(measured: Measured, start: gtsam.Values) -> MotionSolution:
    """Poses and inliers by graduated non-convexity; all motions are kept."""
    backbone = joined(measured.prior, factor_graph(measured.odometry))
    problem = gnc.TruncatedProblem(backbone, measured.closures, measured.inlier_bound, penalties=measured.penalties())
    return MotionSolution(gnc.solve(problem, start), np.zeros(len(measured.odometry), dtype=bool))


def solve_consistent(measured: Measured, start: gtsam.Values, rejected: Mask) -> MotionSolution:
    """Poses and inliers starting from the largest pairwise-consistent set, and motions that are rejected (again)."""
    if len(measured.closures) > MAX_PAIRED:
        return solve_gnc(measured, start)
    near = neighbours(ends_m(measured.closures, measured.travel_m), PLACE_M)
    drive = Constants(
        measured.prior,
        measured.closures,
        measured.penalties(),
        near,
        measured.inlier_bound,
        measured.claimed_bound,
    )
    return solve(drive, measured.odometry, start, rejected)
