"""Graduated non-convexity over a pose graph: which closures to believe, decided together with the poses.

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

from dataclasses import dataclass

import gtsam
import numpy as np

from segslam.pose_graph.closures import Closure, squared_errors
from segslam.pose_graph.solver import optimum
from segslam.types import Vector

CONTROL_FACTOR = 1.4  # growth of mu in the paper
MAX_STEPS = 100
NEGLIGIBLE_WEIGHT = 1e-6
"""A closure of less weight is left out of the linear system."""


@dataclass(frozen=True, slots=True, eq=False)
class TruncatedProblem:
    """Factors that are never doubted, and closures that cost at most half of `inlier_bound`."""

    trusted: gtsam.NonlinearFactorGraph
    closures: list[Closure]
    inlier_bound: float
    """Of the squared whitened error (chi-square, not half of it)."""

    def inliers(self, values: gtsam.Values) -> Vector:
        """(k,) 1 for each closure within the bound, else 0."""
        return (squared_errors(self.closures, values) <= self.inlier_bound).astype(float)

    def cost(self, values: gtsam.Values) -> float:
        """The truncated error, half a chi-square as GTSAM's."""
        truncated = np.minimum(squared_errors(self.closures, values), self.inlier_bound)
        return float(self.trusted.error(values) + truncated.sum() / 2.0)

    def weighted(self, weights: Vector) -> gtsam.NonlinearFactorGraph:
        """The least-squares problem in which closure i has its information times `weights[i]`."""
        graph = gtsam.NonlinearFactorGraph(self.trusted)
        for closure, weight in zip(self.closures, weights, strict=True):
            if weight > NEGLIGIBLE_WEIGHT:
                graph.add(closure.factor(weight=weight))
        return graph


def solve(problem: TruncatedProblem, start: gtsam.Values) -> tuple[gtsam.Values, Vector]:
    """The poses, and for each closure whether to believe it (1) or not (0).

    Graduated non-convexity promises no global optimum, so what it finds competes with the optimum next to `start`.
    """
    found = (_settle(problem, _graduate(problem, start)), _settle(problem, start))
    return min(found, key=lambda result: problem.cost(result[0]))


def _graduate(problem: TruncatedProblem, start: gtsam.Values) -> gtsam.Values:
    """Algorithm 1: from the optimum that believes all to where each closure is believed or not."""
    values = optimum(problem.weighted(np.ones(len(problem.closures))), start)
    worst = squared_errors(problem.closures, values).max(initial=0.0)
    if worst <= problem.inlier_bound:
        return values
    control = problem.inlier_bound / (2.0 * worst - problem.inlier_bound)
    for _ in range(MAX_STEPS):
        weights = tls_weights(squared_errors(problem.closures, values), control, problem.inlier_bound)
        if np.minimum(weights, 1.0 - weights).max() < NEGLIGIBLE_WEIGHT:
            break
        graph = problem.weighted(weights)
        values = values.retract(graph.linearize(values).optimize())
        control *= CONTROL_FACTOR
    return values


def tls_weights(squared: Vector, control: float, inlier_bound: float) -> Vector:
    """(k,) 0 to 1, the surrogate's weights of truncated least squares."""
    low, high = inlier_bound * control / (control + 1.0), inlier_bound * (control + 1.0) / control
    weights = np.sqrt(inlier_bound * control * (control + 1.0) / np.clip(squared, low, high)) - control
    return np.clip(weights, 0.0, 1.0)


def _settle(problem: TruncatedProblem, values: gtsam.Values) -> tuple[gtsam.Values, Vector]:
    """The optimum of the truncated cost next to `values`: believe what is within the bound, optimise, look again.

    Neither half raises the cost, so this ends; MAX_STEPS guards against rounding at the bound.
    """
    weights = problem.inliers(values)
    for _ in range(MAX_STEPS):
        values = optimum(problem.weighted(weights), values)
        within = problem.inliers(values)
        if (within == weights).all():
            break
        weights = within
    return values, weights
