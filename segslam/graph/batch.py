"""Optimisation of a whole pose graph from a file."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import compress
from time import perf_counter
from typing import Literal

import gtsam
import numpy as np
from scipy.special import chdtrc

from segslam.core.types import Mask, SegslamError, Vector
from segslam.graph import gnc, noise
from segslam.graph.batch_search import IMPLAUSIBLE, FileProblem, least_squares, plausible, select
from segslam.graph.edges import factor_graph, joined, poses_by_id, squared_errors, values_of
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


def optimize_graph(graph: G2oGraph, *, robust: Robust = "consistent") -> Optimized:
    """The optimum of a graph near the file's poses or, where those are a bad guess, near chordal poses.

    Edges between consecutive ids count as odometry and are always kept, unless several between the same two contradict
    each other: then they are closures, too. All others are closures: kept (`none`), under a robust kernel, or kept or
    rejected by graduated non-convexity (`gnc`) or starting from a pairwise-consistent set (`consistent`). The bound of
    inliers is a chi-square that all of them are below with `INLIER_PROBABILITY`.
    If odometry alone does not connect the graph, `gnc` raises SegslamError, and `consistent` falls back to `cauchy`.
    """
    problem = FileProblem.of(graph)
    robust = _possible(robust, graph, problem)
    start = values_of(graph.T_world_vertex.values(), graph.T_world_vertex)
    backbone = gtsam.NonlinearFactorGraph()
    for vertex in graph.fixed or (next(iter(graph.T_world_vertex)),):  # these fix the world frame
        backbone.add(gtsam.PriorFactorPose3(vertex, start.atPose3(vertex), noise.FIRST_POSE))
    backbone.push_back(factor_graph(problem.odometry))
    started = perf_counter()
    found, weights = _solve(problem, backbone, start, robust)
    return _described(graph, problem, start, found, weights > 0.0, robust, perf_counter() - started)


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
    problem: FileProblem, backbone: gtsam.NonlinearFactorGraph, start: gtsam.Values, robust: Robust
) -> tuple[Search, Vector]:
    """The poses, and the weight of each closure: 0 if it was rejected."""
    everything = np.ones(len(problem.closures))
    if robust in ("gnc", "consistent"):
        truncated = gnc.TruncatedProblem(backbone, problem.closures, problem.inlier_bound, everything)
        solution = gnc.solve(truncated, start) if robust == "gnc" else select(problem, truncated, start)
        return solution.search, solution.weights
    kernel = noise.robust_kernel(robust, noise.inlier_bound())
    factors = joined(backbone, factor_graph(problem.closures, kernel=kernel))
    if kernel is None:
        return least_squares(factors, start, redundancy=problem.redundancy(len(everything))), everything
    return search(factors, start), everything


def _described(
    graph: G2oGraph,
    problem: FileProblem,
    start: gtsam.Values,
    found: Search,
    kept: Mask,
    robust: Robust,
    seconds: float,
) -> Optimized:
    odometry, closures = factor_graph(problem.odometry), factor_graph(problem.closures)
    before, after = squared_errors(closures, start), squared_errors(closures, found.values)
    is_outlier = after > problem.inlier_bound
    fitted = kept if robust == "none" else kept & ~is_outlier
    chi2 = np.concatenate([squared_errors(odometry, found.values), after[fitted]])
    redundancy = problem.redundancy(int(fitted.sum()))
    poses = dict(zip(sorted(graph.T_world_vertex), poses_by_id(found.values), strict=True))
    median, p95, most = np.quantile(chi2, [0.5, 0.95, 1.0]).tolist() if len(chi2) else (0.0, 0.0, 0.0)
    return Optimized(
        graph=replace(graph, T_world_vertex={vertex: poses[vertex] for vertex in graph.T_world_vertex}),
        robust=robust,
        initial_error=odometry.error(start) + 0.5 * float(before[kept].sum()),
        final_error=odometry.error(found.values) + 0.5 * float(after[kept].sum()),
        robust_cost=None if robust in ("none", "gnc", "consistent") else found.error,
        iterations=found.iterations,
        seconds=seconds,
        num_outliers=int(is_outlier.sum()),
        outliers=tuple((edge.a, edge.b) for edge in compress(problem.closures, is_outlier)),
        chi2_per_dof=float(chi2.sum()) / redundancy if redundancy > 0 else None,
        chi2_quantiles=(median, p95, most),
        doubts=tuple(_warnings(problem, found, fitted, chi2)),
    )


def _warnings(problem: FileProblem, found: Search, fitted: Mask, chi2: Vector) -> Iterator[str]:
    """Why a solution may be wrong, by the closures that are `fitted`, and the chi-squares of odometry and of these."""
    total, redundancy = float(chi2.sum()), problem.redundancy(int(fitted.sum()))
    if not found.converged:
        yield "the search stopped before it converged"
    if not plausible(total, redundancy):
        yield (
            f"the edges fit worse than their information claims: chi-square {total:.6g} with {redundancy} degrees of "
            f"freedom, probability {chdtrc(redundancy, total):.1g}"
        )
    share = float(fitted.mean()) if len(fitted) else 1.0
    if share < MIN_KEPT:
        yield f"only {share:.0%} of the closures are inliers"
    worst = chi2.max(initial=0.0)
    if len(chi2) and len(chi2) * chdtrc(noise.DEGREES_OF_FREEDOM, worst) < IMPLAUSIBLE:  # the largest of so many
        edge = [*problem.odometry, *compress(problem.closures, fitted)][int(np.argmax(chi2))]
        yield (
            f"the edge from {edge.a} to {edge.b} is kept with a chi-square of {worst:.6g}, far above the "
            f"{noise.DEGREES_OF_FREEDOM} that its information claims"
        )
    for a, b in problem.undecided(fitted):
        yield f"the edges between {a} and {b} contradict each other, and no closure shows which is correct"
