"""Truncated least squares over a pose graph: inliers among the closures, decided together with the poses.

Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020:
truncated least squares, in which a closure costs at most its bound.

| symbol | here |
|---|---|
| r_i^2 | `squared`: squared whitened error (chi-square) of closure i |
| c_bar^2 | `inlier_bound` |
| mu | `control` |
| w_i | `weights` |

Differs from the paper and from GTSAM's GncOptimizer, which optimise until convergence from the first values at each mu:
here each mu takes one Gauss-Newton step from the last values, which is enough for a small change of weights.
Levenberg-Marquardt follows at the end.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from segslam.core.robust import CONTROL_FACTOR, first_control, tls_weights
from segslam.core.types import Mask, Vector
from segslam.graph.edges import Edge, factor_graph, squared_errors
from segslam.graph.levenberg_marquardt import Search, search, step

MAX_STEPS = 100
NEGLIGIBLE_WEIGHT = 1e-6
"""Closures with a smaller weight are left out of the linear system."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Poses, and which closures are inliers."""

    search: Search
    """Its error is that of the factors without closures that were rejected."""
    weights: Vector
    """(k,) 1 for an inlier, 0 for a rejected closure."""
    truncated_cost: float
    """The error of `search` and, for each rejected closure, half the bound times its penalty."""


class TruncatedProblem:
    """Factors that are always kept, and closures that are kept or cost their penalty times half of `inlier_bound`.

    The bound is one of the squared whitened error (chi-square, not half of it).
    """

    def __init__(
        self,
        backbone: gtsam.NonlinearFactorGraph,
        closures: Sequence[Edge],
        inlier_bound: float,
        *,
        penalties: Vector | None = None,
    ) -> None:
        """`penalties` (k,) 0 to 1: cost of rejecting each closure; low for closures that may be wrong together."""
        self.inlier_bound = inlier_bound
        self._penalties = np.ones(len(closures)) if penalties is None else penalties
        self._backbone = backbone
        self._closures = closures
        self._factors = factor_graph(closures)

    def squared_errors(self, values: gtsam.Values) -> Vector:
        """(k,) chi-square of each closure."""
        return squared_errors(self._factors, values)

    def inliers(self, values: gtsam.Values) -> Vector:
        """(k,) 1 for each closure within the bound, else 0."""
        return (self.squared_errors(values) <= self.inlier_bound).astype(float)

    def cost(self, error: float, weights: Vector) -> float:
        """The truncated cost of a solution, from the error of the factors that it keeps."""
        return error + 0.5 * self.inlier_bound * float(self._penalties[weights == 0.0].sum())

    def weighted(self, weights: Vector) -> gtsam.NonlinearFactorGraph:
        """The least-squares problem in which closure i has its information times `weights[i]`."""
        graph = gtsam.NonlinearFactorGraph(self._backbone)
        for i, (closure, weight) in enumerate(zip(self._closures, weights, strict=True)):
            if weight == 1.0:
                graph.add(self._factors.at(i))
            elif weight > NEGLIGIBLE_WEIGHT:
                graph.add(closure.factor(weight=float(weight)))
        return graph


def solve(problem: TruncatedProblem, start: gtsam.Values) -> Solution:
    """Poses and inliers by graduated non-convexity, or near `start` if their cost is lower there.

    Neither is sure to be the global optimum.
    """
    values, iterations = _graduate(problem, start)
    graduated = settle(problem, values, iterations)
    return graduated if graduated.weights.all() else better(graduated, settle(problem, start))


def better(first: Solution, second: Solution) -> Solution:
    """The solution with the lower truncated cost."""
    return second if second.truncated_cost < first.truncated_cost else first


def settle_from(problem: TruncatedProblem, start: gtsam.Values, likely: Mask) -> Solution:
    """The solution near the optimum, searched from `start`, of some `likely` closures (k,)."""
    found = search(problem.weighted(likely.astype(float)), start)
    return settle(problem, found.values, found.iterations)


def _graduate(problem: TruncatedProblem, start: gtsam.Values) -> tuple[gtsam.Values, int]:
    """Algorithm 1: from the optimum of all closures to weights of 0 and 1; the poses, and the number of iterations."""
    values, _, iterations, _ = search(problem.weighted(np.ones(len(problem.squared_errors(start)))), start)
    worst = problem.squared_errors(values).max(initial=0.0)
    if worst <= problem.inlier_bound:
        return values, iterations
    control = first_control(worst, problem.inlier_bound)
    for _ in range(MAX_STEPS):
        weights = tls_weights(problem.squared_errors(values), control, problem.inlier_bound)
        if np.minimum(weights, 1.0 - weights).max() < NEGLIGIBLE_WEIGHT:
            break
        values = step(problem.weighted(weights), values)
        iterations += 1
        control *= CONTROL_FACTOR
    return values, iterations


def settle(problem: TruncatedProblem, values: gtsam.Values, iterations: int = 0) -> Solution:
    """Local optimum of the truncated cost near `values`: keep the closures within the bound, optimise, repeat.

    With penalties of 1 neither half raises the cost, so this ends; MAX_STEPS guards against other penalties and against
    rounding at the bound.
    """
    within = problem.inliers(values)
    for _ in range(MAX_STEPS):
        weights = within
        found = search(problem.weighted(weights), values)
        values, iterations = found.values, iterations + found.iterations
        within = problem.inliers(values)
        if (within == weights).all():
            break
    return Solution(found._replace(iterations=iterations), weights, problem.cost(found.error, weights))
