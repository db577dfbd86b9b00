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


def search(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, *, tolerance: float = 1e-5) -> Search:
    """The least error near `start`, by Levenberg-Marquardt.

    It ends with an iteration that lowers the error by a share below `tolerance`; what is left is far less, for the
    search converges quadratically.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setlambdaFactor(LAMBDA_FACTOR)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    values = optimizer.optimize()
    return Search(values, optimizer.error(), optimizer.iterations())
