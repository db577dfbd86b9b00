"""Truncated least squares over a pose graph: which closures to believe, decided together with the poses.

Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020:
truncated least squares, in which a closure costs at most its bound.

| symbol | here |
|---|---|
| r_i^2 | `squared`: squared whitened error (chi-square) of closure i |
| c_bar^2 | `inlier_bound` |
| mu | `control` |
| w_i | `weights` |

Differs from the paper, and from GTSAM's GncOptimizer, which optimises to the end and from the first values at each mu:
each mu takes one Gauss-Newton step from the last values, all that a small change of weights asks for. Levenberg-
Marquardt comes at the end.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from segslam.pose_graph.edges import Edge, factor_graph, squared_errors
from segslam.pose_graph.solver import Search, search, step
from segslam.types import Mask, Vector

CONTROL_FACTOR = 1.4  # growth of mu in the paper
MAX_STEPS = 100
NEGLIGIBLE_WEIGHT = 1e-6
"""A closure of less weight is left out of the linear system."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Poses, and which closures to believe."""

    search: Search
    """Its error is of all that is believed."""
    weights: Vector
    """(k,) 1 believed, 0 switched off."""
    truncated_cost: float
    """Error of all that is believed, and half the bound, times its say, for each closure that is not."""


class TruncatedProblem:
    """Factors that are never doubted, and closures that are believed or cost their say times half of `inlier_bound`.

    The bound is of the squared whitened error (chi-square, not half of it).
    """

    def __init__(
        self,
        trusted: gtsam.NonlinearFactorGraph,
        closures: Sequence[Edge],
        inlier_bound: float,
        *,
        says: Vector | None = None,
    ) -> None:
        """`says` (k,) 0 to 1: what not to believe a closure costs; less for closures that may be wrong together."""
        self.inlier_bound = inlier_bound
        self._says = np.ones(len(closures)) if says is None else says
        self._trusted = trusted
        self._closures = closures
        self._factors = factor_graph(closures)

    def squared_errors(self, values: gtsam.Values) -> Vector:
        """(k,) chi-square of each closure."""
        return squared_errors(self._factors, values)

    def inliers(self, values: gtsam.Values) -> Vector:
        """(k,) 1 for each closure within the bound, else 0."""
        return (self.squared_errors(values) <= self.inlier_bound).astype(float)

    def cost(self, error: float, weights: Vector) -> float:
        """Of poses with this error of all that is believed: what is compared between solutions."""
        return error + 0.5 * self.inlier_bound * float(self._says[weights == 0.0].sum())

    def weighted(self, weights: Vector) -> gtsam.NonlinearFactorGraph:
        """The least-squares problem in which closure i has its information times `weights[i]`."""
        graph = gtsam.NonlinearFactorGraph(self._trusted)
        for i, (closure, weight) in enumerate(zip(self._closures, weights, strict=True)):
            if weight == 1.0:
                graph.add(self._factors.at(i))
            elif weight > NEGLIGIBLE_WEIGHT:
                graph.add(closure.factor(weight=float(weight)))
        return graph


def solve(problem: TruncatedProblem, start: gtsam.Values) -> Solution:
    """The poses, and for each closure whether to believe it: by graduated non-convexity, or next to `start` if better.

    Neither promises the global optimum.
    """
    values, iterations = _graduate(problem, start)
    graduated = settle(problem, values, iterations)
    return graduated if graduated.weights.all() else better(graduated, settle(problem, start))


def better(first: Solution, second: Solution) -> Solution:
    """That of the lower cost."""
    return second if second.truncated_cost < first.truncated_cost else first


def settle_from(problem: TruncatedProblem, start: gtsam.Values, likely: Mask) -> Solution:
    """The solution next to the optimum, searched from `start`, of those closures that are `likely` (k,)."""
    found = search(problem.weighted(likely.astype(float)), start)
    return settle(problem, found.values, found.iterations)


def _graduate(problem: TruncatedProblem, start: gtsam.Values) -> tuple[gtsam.Values, int]:
    """Algorithm 1: from the optimum that believes all to where each closure is believed or not; and the iterations."""
    values, _, iterations = search(problem.weighted(np.ones(len(problem.squared_errors(start)))), start)
    worst = problem.squared_errors(values).max(initial=0.0)
    if worst <= problem.inlier_bound:
        return values, iterations
    control = problem.inlier_bound / (2.0 * worst - problem.inlier_bound)
    for _ in range(MAX_STEPS):
        weights = tls_weights(problem.squared_errors(values), control, problem.inlier_bound)
        if np.minimum(weights, 1.0 - weights).max() < NEGLIGIBLE_WEIGHT:
            break
        values = step(problem.weighted(weights), values)
        iterations += 1
        control *= CONTROL_FACTOR
    return values, iterations


def tls_weights(squared: Vector, control: float, inlier_bound: float) -> Vector:
    """(k,) 0 to 1, the surrogate's weights of truncated least squares."""
    low, high = inlier_bound * control / (control + 1.0), inlier_bound * (control + 1.0) / control
    weights = np.sqrt(inlier_bound * control * (control + 1.0) / np.clip(squared, low, high)) - control
    return np.clip(weights, 0.0, 1.0)


def settle(problem: TruncatedProblem, values: gtsam.Values, iterations: int = 0) -> Solution:
    """The optimum of the truncated cost next to `values`: believe what is within the bound, optimise, look again.

    Neither half raises the cost, so this ends; MAX_STEPS guards against rounding at the bound.
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
