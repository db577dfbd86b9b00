"""Optimisation of a whole pose graph from a file."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from time import perf_counter
from typing import Literal

import gtsam
import numpy as np
from scipy.special import chdtrc

from segslam.core.types import SegslamError, Vector
from segslam.graph import gnc, noise
from segslam.graph.batch_search import IMPLAUSIBLE, FileProblem, least_squares, plausible, select
from segslam.graph.edges import Edge, factor_graph, joined, poses_by_id, squared_errors
from segslam.graph.g2o import G2oGraph, parts
from segslam.graph.levenberg_marquardt import Search, search

logger = logging.getLogger(__name__)
Robust = Literal["none", "huber", "cauchy", "geman-mcclure", "gnc", "consistent"]
FALLBACK: Robust = "cauchy"
"""Kernel that replaces `consistent` if odometry does not connect the graph."""
MIN_KEPT = 0.65
"""A result with a smaller share of its closures among the inliers may be wrong. Chosen."""


@dataclass(frozen=True, slots=True, eq=False)
class Optimized:
    """The optimum of a graph, and how it was reached."""

    graph: G2oGraph
    robust: Robust
    """The kernel or the selection of closures that was used."""
    initial_error: float
    """Half the chi-square, at the file's poses, of the edges kept at the end: all but the closures that `gnc` or
    `consistent` rejected."""
    final_error: float
    """Half the chi-square of the same edges at the optimum."""
    robust_cost: float | None
    """The cost that was minimised, under a robust kernel; None where that is the final error."""
    iterations: int
    seconds: float
    """Duration of the search alone."""
    num_outliers: int
    """Closures whose chi-square at the end is above the bound of inliers."""
    outliers: tuple[tuple[int, int], ...]
    """The ids of their vertices, in the order of the file."""
    chi2_per_dof: float | None
    """Chi-square per degree of freedom of all edges but outliers: 1 if the noise of the edges is as claimed. None if
    nothing is redundant."""
    chi2_quantiles: tuple[float, float, float]
    """Median, 95th percentile and maximum of the chi-squares of all edges but outliers."""
    doubts: tuple[str, ...]
    """Reasons why the result may be wrong."""

    @property
    def converged(self) -> bool:
        """True if no check found a reason why the result may be wrong."""
        return not self.doubts


def optimize_graph(graph: G2oGraph, *, robust: Robust = "consistent", inlier_probability: float = 0.99) -> Optimized:
    """The optimum of a graph near the file's poses or, where those are a bad guess, near chordal poses.

    Edges between consecutive ids count as odometry and are always kept, unless several between the same two contradict
    each other: then they are closures, too. All others are closures: kept (`none`), under a robust kernel, or kept or
    rejected by graduated non-convexity (`gnc`) or starting from a pairwise-consistent set (`consistent`). The bound of
    inliers is a chi-square that all of them are below with `inlier_probability`.
    If odometry alone does not connect the graph, `gnc` raises SegslamError, and `consistent` falls back to `cauchy`.
    """
    problem = FileProblem.of(graph, inlier_probability)
    start = _values(graph)
    robust = _possible(robust, graph, problem)
    started = perf_counter()
    solution = _solve(problem, _anchors(graph, start), start, robust, inlier_probability)
    seconds = perf_counter() - started
    return _described(graph, problem, start, solution, robust, seconds)


def _possible(robust: Robust, graph: G2oGraph, problem: FileProblem) -> Robust:
    """`robust`, or its replacement if odometry does not connect the graph."""
    if robust not in ("gnc", "consistent") or not parts(graph.T_world_vertex, problem.odometry).any():
        return robust
    if robust == "gnc":
        raise SegslamError(
            "--robust gnc always keeps odometry, but edges between consecutive ids alone do not connect this graph; "
            f"use --robust {FALLBACK}"
        )
    logger.warning(
        "edges between consecutive ids alone do not connect this graph, so there is no odometry to compare closures "
        "by: --robust %s is used instead of consistent",
        FALLBACK,
    )
    return FALLBACK


def _solve(
    problem: FileProblem,
    anchors: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    robust: Robust,
    inlier_probability: float,
) -> tuple[Search, Vector]:
    """The poses, and the weight of each closure: 0 if it was rejected."""
    backbone = joined(anchors, factor_graph(problem.odometry))
    weights = np.ones(len(problem.closures))
    if robust in ("gnc", "consistent"):
        truncated = gnc.TruncatedProblem(backbone, problem.closures, problem.inlier_bound)
        solution = gnc.solve(truncated, start) if robust == "gnc" else select(problem, truncated, start)
        return solution.search, solution.weights
    if robust == "none":
        factors = joined(backbone, factor_graph(problem.closures))
        return least_squares(factors, start, redundancy=problem.redundancy(weights)), weights
    kernel = noise.robust_kernel(robust, noise.inlier_bound(inlier_probability))
    return search(joined(backbone, factor_graph(problem.closures, kernel=kernel)), start), weights


def _described(
    graph: G2oGraph,
    problem: FileProblem,
    start: gtsam.Values,
    solution: tuple[Search, Vector],
    robust: Robust,
    seconds: float,
) -> Optimized:
    found, weights = solution
    odometry, closures = factor_graph(problem.odometry), factor_graph(problem.closures)
    before, after = squared_errors(closures, start), squared_errors(closures, found.values)
    is_outlier = after > problem.inlier_bound
    kept = weights > 0.0
    fitted = kept if robust == "none" else kept & ~is_outlier
    spread = np.concatenate([squared_errors(odometry, found.values), after[fitted]])
    redundancy = problem.redundancy(fitted.astype(float))
    chi2 = float(spread.sum())
    poses = dict(zip(sorted(graph.T_world_vertex), poses_by_id(found.values), strict=True))
    median, p95, most = np.quantile(spread, [0.5, 0.95, 1.0]).tolist() if len(spread) else (0.0, 0.0, 0.0)
    return Optimized(
        graph=replace(graph, T_world_vertex={vertex: poses[vertex] for vertex in graph.T_world_vertex}),
        robust=robust,
        initial_error=odometry.error(start) + 0.5 * float(before[kept].sum()),
        final_error=odometry.error(found.values) + 0.5 * float(after[kept].sum()),
        robust_cost=None if robust in ("none", "gnc", "consistent") else found.error,
        iterations=found.iterations,
        seconds=seconds,
        num_outliers=int(is_outlier.sum()),
        outliers=tuple((edge.a, edge.b) for edge, out in zip(problem.closures, is_outlier, strict=True) if out),
        chi2_per_dof=chi2 / redundancy if redundancy > 0 else None,
        chi2_quantiles=(median, p95, most),
        doubts=(
            *_warnings(found, chi2, redundancy, float(fitted.mean()) if len(fitted) else 1.0),
            *_poor_edges([*problem.odometry, *compress(problem.closures, fitted)], spread),
            *(
                f"the edges between {a} and {b} contradict each other, and no closure shows which is correct"
                for a, b in problem.undecided(fitted.astype(float))
            ),
        ),
    )


def _poor_edges(edges: Sequence[Edge], chi2: Vector) -> Iterator[str]:
    """The kept edge that fits worst, if its chi-square is improbable for the largest of so many."""
    if len(chi2) == 0:
        return
    worst = int(np.argmax(chi2))
    if len(chi2) * chdtrc(noise.DEGREES_OF_FREEDOM, chi2[worst]) < IMPLAUSIBLE:
        edge = edges[worst]
        yield (
            f"the edge from {edge.a} to {edge.b} is kept with a chi-square of {chi2[worst]:.6g}, far above the "
            f"{noise.DEGREES_OF_FREEDOM} that its information claims"
        )


def _warnings(found: Search, chi2: float, redundancy: int, share: float) -> list[str]:
    doubts = []
    if not found.converged:
        doubts.append("the search stopped before it converged")
    if not plausible(chi2, redundancy):
        doubts.append(
            f"the edges fit worse than their information claims: chi-square {chi2:.6g} with {redundancy} degrees of "
            f"freedom, probability {chdtrc(redundancy, chi2):.1g}"
        )
    if share < MIN_KEPT:
        doubts.append(f"only {share:.0%} of the closures are inliers")
    return doubts


def _values(graph: G2oGraph) -> gtsam.Values:
    values = gtsam.Values()
    for vertex, T_world_vertex in graph.T_world_vertex.items():
        values.insert(vertex, gtsam.Pose3(T_world_vertex))
    return values


def _anchors(graph: G2oGraph, start: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """Priors that fix the world frame: on the fixed vertices, or on the first one in the file."""
    anchors = gtsam.NonlinearFactorGraph()
    for vertex in graph.fixed or (next(iter(graph.T_world_vertex)),):
        anchors.add(gtsam.PriorFactorPose3(vertex, start.atPose3(vertex), noise.first_pose()))
    return anchors
