"""The optimum of a graph, searched from a start."""

from typing import NamedTuple

import gtsam

LAMBDA_FACTOR = 100.0
"""Growth and shrinkage of the damping (GTSAM: 10): near the optimum, where most searches start, an iteration less."""


class Search(NamedTuple):
    """What a search found, and after how many linear systems."""

    values: gtsam.Values
    error: float
    """GTSAM's: half the chi-square, robust kernels included."""
    iterations: int


def search(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> Search:
    """The least error near `start`, by Levenberg-Marquardt."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaFactor(LAMBDA_FACTOR)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    values = optimizer.optimize()
    return Search(values, optimizer.error(), optimizer.iterations())
