"""Local optimisation of a graph by Levenberg-Marquardt."""

import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import gtsam

from segslam.core.types import SegslamError

LAMBDA_FACTOR = 100.0
"""Factor of the damping (GTSAM: 10); near the optimum, where most searches start, it saves an iteration."""

SHALLOW = 10_000
"""Poses for which any thread's stack is deep enough."""
STACK_BYTES_PER_POSE = 4096
"""Chosen: 8 MB are enough for 50,000 poses of `tools/benchmarks/speed`, not for 100,000. Unused stack costs nothing."""

EXACT = 1e-9
"""Half a chi-square that no noise causes: poses that fit all edges but for rounding. Chosen."""

Done = TypeVar("Done")


class Unsolvable(SegslamError):
    """The optimum cannot be computed: the edges do not determine all poses, or their numbers are too different."""


class Search(NamedTuple):
    """Result of a search: poses, error, number of linear systems solved."""

    values: gtsam.Values
    error: float
    """GTSAM's: half the chi-square, robust kernels included."""
    iterations: int
    converged: bool = True
    """False if the search stopped at its bound of iterations or of damping."""


def search(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, *, tolerance: float = 1e-5) -> Search:
    """Minimise the error from `start` by Levenberg-Marquardt.

    It ends with an iteration that lowers the error by a share below `tolerance`. The distance left to the optimum is
    far less, because the search converges quadratically. Raises Unsolvable.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setlambdaFactor(LAMBDA_FACTOR)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    values = deeply(start.size(), optimizer.optimize)
    stopped = (
        optimizer.iterations() >= parameters.getMaxIterations()
        or optimizer.lambda_() >= parameters.getlambdaUpperBound()
    )
    exact = optimizer.error() < EXACT  # rounding then prevents further steps
    return Search(values, optimizer.error(), optimizer.iterations(), converged=exact or not stopped)


def step(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """One Gauss-Newton step. Raises Unsolvable."""
    return values.retract(deeply(values.size(), graph.linearize(values).optimize))


def deeply(num_poses: int, work: Callable[[], Done]) -> Done:
    """Work done on a stack deep enough for GTSAM, which calls itself along the drive and crashes where a stack ends.

    Raises Unsolvable for an error of GTSAM.
    """
    if num_poses <= SHALLOW:
        return _solved(work)
    usual = threading.stack_size(num_poses * STACK_BYTES_PER_POSE)
    try:
        thread = ThreadPoolExecutor(1)
        done = thread.submit(_solved, work)  # this is when the thread begins
    finally:
        threading.stack_size(usual)
    with thread:
        return done.result()


def _solved(work: Callable[[], Done]) -> Done:
    try:
        return work()
    except RuntimeError as error:
        found = re.search(r"near variable (\w+)", " ".join(str(error).split()))
        where = f" near vertex {found[1]}" if found else ""
        raise Unsolvable(
            f"the poses{where} cannot be computed: an edge has far larger numbers than the others, or the edges leave "
            "a direction open; correct or remove the edge"
        ) from error
