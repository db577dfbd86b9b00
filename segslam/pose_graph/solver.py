"""The optimum of a graph, searched from a start."""

import gtsam


def optimum(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    """The least error near `start`, by Levenberg-Marquardt as GTSAM has it by default."""
    return gtsam.LevenbergMarquardtOptimizer(graph, start, gtsam.LevenbergMarquardtParams()).optimize()
