"""The optimum of a graph, searched from a start."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import gtsam

LAMBDA_FACTOR = 100.0
"""Growth and shrinkage of the damping (GTSAM: 10): near the optimum, where most searches start, an iteration less."""

SHALLOW = 10_000
"""Poses for which any thread's stack is deep enough."""
STACK_BYTES_PER_POSE = 4096
"""Chosen: 8 MB are enough for 50,000 poses of `tools/bench.py` and not for 100,000. What is not used costs nothing."""

Done = TypeVar("Done")


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
    values = _deeply(start.size(), optimizer.optimize)
    return Search(values, optimizer.error(), optimizer.iterations())


def step(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """One step of Gauss and Newton."""
    return values.retract(_deeply(values.size(), graph.linearize(values).optimize))


def _deeply(num_poses: int, work: Callable[[], Done]) -> Done:
    """Work done on a stack deep enough for GTSAM, which calls itself along the drive and crashes where a stack ends."""
    if num_poses <= SHALLOW:
        return work()
    usual = threading.stack_size(num_poses * STACK_BYTES_PER_POSE)
    try:
        thread = ThreadPoolExecutor(1)
        done = thread.submit(work)  # this is when the thread begins
    finally:
        threading.stack_size(usual)
    with thread:
        return done.result()
