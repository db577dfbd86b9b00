"""The search for the optimum of a graph from a file, and for the inliers among its closures."""

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, compress

import gtsam
import numpy as np
from scipy.special import chdtrc

from segslam.core import geometry
from segslam.core.probabilities import INLIER_PROBABILITY, SIGNIFICANT
from segslam.core.types import Mask
from segslam.graph import gnc, noise
from segslam.graph.closure_pairs import MAX_PAIRED, adjoints, consistent_pairs, largest_consistent, neighbours
from segslam.graph.edges import Edge
from segslam.graph.g2o import G2oGraph
from segslam.graph.gnc import Solution, TruncatedProblem
from segslam.graph.levenberg_marquardt import Search, deeply, search

logger = logging.getLogger(__name__)
IMPLAUSIBLE = 1e-6
"""A fit less probable than this, under the noise of the edges, is implausible. Chosen."""
NEAR_IDS = 10
"""Closures whose ends are this near in ids join the same two places. Chosen: a ring of `sphere2500` has 50 vertices."""
MIN_KEPT = 0.8
"""A plausible solution that keeps this share of the closures is not compared with others. Chosen."""
GOOD_START = 0.5
"""The file's poses are a start of their own where this share of the closures fits them. Chosen."""
GENEROUS = 4.0
"""Closures with an error below this many bounds are also tried as inliers. Chosen: twice the error of an inlier."""


@dataclass(frozen=True, slots=True, eq=False)
class FileProblem:
    """The edges of a file by their role."""

    num_vertices: int
    num_fixed: int
    """Vertices whose poses are given, at least one."""
    odometry: list[Edge]
    """Edges between consecutive ids; where several contradict each other, one without information."""
    closures: list[Edge]
    """All other edges, and those between consecutive ids that contradict each other."""
    contradicting: list[list[Edge]]
    """Edges between the same neighbours that contradict each other."""
    inlier_bound: float
    """Chi-square that all closures, if all are inliers, are below with `INLIER_PROBABILITY`."""

    @classmethod
    def of(cls, graph: G2oGraph) -> "FileProblem":
        """The edges of a graph."""
        groups = contradicting([edge for edge in graph.edges if abs(edge.a - edge.b) == 1])
        moved = {id(edge) for edges in groups for edge in edges}
        odometry = [edge for edge in graph.edges if abs(edge.a - edge.b) == 1 and id(edge) not in moved]
        odometry += [replace(edges[0], information=noise.UNKNOWN_MOTION) for edges in groups]
        closures = [edge for edge in graph.edges if abs(edge.a - edge.b) != 1 or id(edge) in moved]
        each = 1.0 - (1.0 - INLIER_PROBABILITY) / max(1, len(closures))
        num_fixed = max(1, len(set(graph.fixed)))
        return cls(len(graph.T_world_vertex), num_fixed, odometry, closures, groups, noise.inlier_bound(each))

    def redundancy(self, num_closures: int) -> int:
        """Degrees of freedom of odometry and so many closures beyond those of the poses."""
        num_edges = len(self.odometry) - len(self.contradicting) + num_closures
        return noise.DEGREES_OF_FREEDOM * (num_edges - self.num_vertices + self.num_fixed)

    def undecided(self, kept: Mask) -> list[tuple[int, int]]:
        """The neighbours whose contradicting edges no kept closure across them decides."""
        moved = {id(edge) for edges in self.contradicting for edge in edges}
        across = [sorted((edge.a, edge.b)) for edge in compress(self.closures, kept) if id(edge) not in moved]
        pairs = [sorted((edges[0].a, edges[0].b)) for edges in self.contradicting]
        return [(a, b) for a, b in pairs if not any(first <= a and b <= last for first, last in across)]

    def chain(self) -> tuple[list[Edge], list[Edge]]:
        """One motion from each vertex to the next, and the closures, with vertices numbered from 0."""
        first_of = {min(edge.a, edge.b): edge for edge in reversed(self.odometry)}
        forwards = [edge if edge.a < edge.b else turned(edge) for _, edge in sorted(first_of.items())]
        first, groups = forwards[0].a, (forwards, self.closures)
        motions, closures = ([replace(edge, a=edge.a - first, b=edge.b - first) for edge in each] for each in groups)
        return motions, closures


def plausible(chi2: float, redundancy: int) -> bool:
    """Whether this chi-square is plausible for edges with this many redundant degrees of freedom."""
    return redundancy <= 0 or float(chdtrc(redundancy, chi2)) > IMPLAUSIBLE


def least_squares(factors: gtsam.NonlinearFactorGraph, start: gtsam.Values, *, redundancy: int) -> Search:
    """The optimum near `start`, or near chordal poses if the first is implausible and the second is better.

    Chordal initialisation: Carlone et al., "Initialization Techniques for 3D SLAM", ICRA 2015.
    """
    near = search(factors, start)
    if plausible(2.0 * near.error, redundancy):
        return near
    logger.info("the optimum near the file's poses does not fit the edges: searching from chordal poses too")
    other = search(factors, deeply(start.size(), lambda: gtsam.InitializePose3.initialize(factors)))
    best = min(near, other, key=lambda found: found.error)
    return best._replace(iterations=near.iterations + other.iterations)


def select(problem: FileProblem, truncated: TruncatedProblem, start: gtsam.Values) -> Solution:
    """Poses and inliers, near the file's poses if those fit many closures, else from a consistent set.

    The search begins with the large groups of the largest consistent set. The whole set, graduated non-convexity and
    groups of rejected closures follow only if the solution is implausible or rejects many closures.
    """
    if not problem.closures:
        return gnc.settle(truncated, least_squares(truncated.weighted(np.ones(0)), start, redundancy=0).values)
    candidates = []
    if truncated.inliers(start).mean() >= GOOD_START:
        candidates.append(_generous(truncated, gnc.settle(truncated, start)))
        if _is_certain(problem, candidates[0]):
            return candidates[0]
    if len(problem.closures) > MAX_PAIRED:
        logger.info("more than %d closures: graduated non-convexity instead of pairwise consistency", MAX_PAIRED)
        return gnc.solve(truncated, start)
    odometry, closures = problem.chain()
    consistent = consistent_pairs(odometry, closures, problem.inlier_bound)
    near = neighbours(closures, np.arange(problem.num_vertices, dtype=float), NEAR_IDS)
    largest = largest_consistent(consistent)

    def settled(likely: Mask) -> Solution:
        factors = truncated.weighted(likely.astype(float))
        found = least_squares(factors, start, redundancy=problem.redundancy(int(likely.sum())))
        return _generous(truncated, gnc.settle(truncated, found.values, found.iterations))

    candidates.append(settled(gnc.large_groups(consistent, near, largest)))
    best = gnc.better(*candidates)
    if _is_certain(problem, best):
        return best
    logger.info("the solution is uncertain: searching from other starts")
    candidates += [settled(largest), gnc.solve(truncated, start)]
    exchanged = [gnc.exchange_groups(truncated, solution, consistent, near) for solution in candidates]
    return _generous(truncated, gnc.better(*exchanged))


def _is_certain(problem: FileProblem, solution: Solution) -> bool:
    """Whether a solution is plausible and keeps most closures."""
    enough = bool(solution.weights.mean() >= MIN_KEPT)
    return enough and plausible(2.0 * solution.search.error, problem.redundancy(int(solution.weights.sum())))


def _generous(truncated: TruncatedProblem, solution: Solution) -> Solution:
    """The solution, or a better one in which closures a little beyond the bound are inliers."""
    squared = truncated.squared_errors(solution.search.values)
    wider = squared <= GENEROUS * truncated.inlier_bound
    if (wider == (solution.weights > 0.0)).all():
        return solution
    return gnc.better(solution, gnc.settle_from(truncated, solution.search.values, wider, solution.search.iterations))


def contradicting(odometry: Sequence[Edge]) -> list[list[Edge]]:
    """Groups of edges between the same two vertices of which at least two differ by more than their noise allows.

    Which of them is correct, only the other edges show.
    """
    same: dict[int, list[Edge]] = defaultdict(list)
    for edge in odometry:
        same[min(edge.a, edge.b)].append(edge)
    bound = noise.inlier_bound(1.0 - SIGNIFICANT)
    return [edges for edges in same.values() if any(_chi2(one, other) > bound for one, other in combinations(edges, 2))]


def turned(edge: Edge) -> Edge:
    """The same measurement from the other vertex."""
    turn = adjoints(geometry.inverse(edge.T_a_b)[None])[0]  # of information: the inverse transposed of covariances'
    return Edge(edge.b, edge.a, geometry.inverse(edge.T_a_b), turn.T @ edge.information @ turn)


def _chi2(one: Edge, other: Edge) -> float:
    """Chi-square of the difference between two measurements of one motion."""
    same_way = other if other.a == one.a else turned(other)
    difference = geometry.log(geometry.inverse(one.T_a_b) @ same_way.T_a_b)
    covariance = np.linalg.inv(one.information) + np.linalg.inv(same_way.information)
    return float(difference @ np.linalg.solve(covariance, difference))
