"""The optimum of a drive with further relative poses, measured all along it and between its passes.

The noise of odometry and of these measurements is known up to a factor each. Both are estimated from how the two
contradict themselves and each other: after a solution, the median of the squared errors of each kind is compared with
its median in a simulation with the noise as claimed, whose solution has the same degrees of freedom.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import gtsam
import numpy as np

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.graph.edges import (
    Edge,
    Kernel,
    factor_graph,
    is_break,
    joined,
    kernel_weights,
    poses_by_id,
    rotated,
    squared_errors,
    values_of,
)
from segslam.graph.levenberg_marquardt import Search, search

ROUNDS = 10
"""Chosen: largest number of estimates of the two factors; they usually settle in three to six."""
SETTLED = 0.05
"""Chosen: relative change of a factor below which the estimate ends."""
LEAST, MOST = np.array([0.05, 0.4]), 20.0
"""Bounds of the factors, least of odometry and of measurements. Chosen on NCLT with an odometry as good as its map: the
measurements share scans, so they contradict each other less than they err."""

LEAST_WEIGHT = 1e-6
"""Keeps the information of an outlier positive definite, as a g2o file requires."""


def solve_adjusted(
    prior: gtsam.NonlinearFactorGraph,
    odometry: Sequence[Edge],
    closures: Sequence[Edge],
    measured: Sequence[Edge],
    start: gtsam.Values,
    kernel: Kernel | None,
) -> tuple[Search, tuple[float, float]]:
    """The optimum near `start`, and the factors of the standard deviations of odometry and of the measurements.

    Closures and measurements are under the kernel. Breaks of the odometry keep their noise.
    """
    fixed = joined(prior, factor_graph(edge for edge in odometry if is_break(edge)))
    groups = [edge for edge in odometry if not is_break(edge)], list(measured)
    factors = np.ones(2)
    rng = np.random.default_rng(0)

    def solved(edges: Sequence[Sequence[Edge]], at: gtsam.Values) -> Search:
        moving, relative, loops = edges
        robust = factor_graph(loops, kernel=kernel), factor_graph(moving), factor_graph(relative, kernel=kernel)
        return search(joined(fixed, *robust), at)

    for _ in range(ROUNDS):
        scaled = [_scaled(group, float(factor)) for group, factor in zip(groups, factors, strict=True)]
        found = solved([*scaled, closures], start)
        start = found.values
        T_world = poses_by_id(start)
        exact = [_simulated(group, T_world, rng) for group in (*scaled, closures)]
        simulated = solved(exact, values_of(T_world))
        real = [_median_chi2(group, start) for group in scaled]
        made = [_median_chi2(group, simulated.values) for group in exact[:2]]
        before = factors
        factors = np.clip(factors * np.sqrt(np.divide(real, made)), LEAST, MOST)
        if np.abs(factors / before - 1.0).max() < SETTLED:
            break
    return found, (float(before[0]), float(before[1]))


def without_shared_rotation(odometry: Sequence[Edge], measured: Sequence[Edge], within: int) -> list[Edge]:
    """Odometry without the rotation per metre that its motions have in common, compared with measurements.

    Beams that point lower than assumed pitch every motion of an odometry from scans. Measurements of corrected scans,
    at most `within` keyframes apart, show this rotation; its median over them is removed from each motion.
    """
    motions = {edge.a: edge for edge in odometry if not is_break(edge)}
    rates = []
    for edge in measured:
        between = [motions[a] for a in range(edge.a, edge.b) if a in motions] if edge.b - edge.a <= within else []
        length_m = sum(geometry.distance(one.T_a_b) for one in between)
        if length_m > 0.0 and len(between) == edge.b - edge.a:
            turn = geometry.log(geometry.inverse(reduce(np.matmul, [one.T_a_b for one in between])) @ edge.T_a_b)[:3]
            rates.append(turn / length_m)
    rate = np.median(rates, axis=0) if rates else np.zeros(3)
    return rotated(odometry, [(edge.a in motions) * geometry.distance(edge.T_a_b) * rate for edge in odometry])


def weighted_edges(
    odometry: Sequence[Edge],
    closures: Sequence[Edge],
    measured: Sequence[Edge],
    factors: tuple[float, float],
    values: gtsam.Values,
    kernel: Kernel | None,
) -> list[Edge]:
    """All edges with the information that they have at the optimum `values`: with the factors of noise of
    `solve_adjusted`, and the weights of the robust kernel."""
    moving = [edge if is_break(edge) else _scaled([edge], factors[0])[0] for edge in odometry]
    robust = [*closures, *_scaled(measured, factors[1])]
    weights = np.maximum(kernel_weights(robust, values, kernel), LEAST_WEIGHT)
    return moving + [replace(edge, information=w * edge.information) for edge, w in zip(robust, weights, strict=True)]


def _scaled(edges: Sequence[Edge], factor: float) -> list[Edge]:
    return [replace(edge, information=edge.information / factor**2) for edge in edges]


def _simulated(edges: Sequence[Edge], T_world: Poses, rng: np.random.Generator) -> list[Edge]:
    """The edges as measured between these poses with errors as their information claims."""
    errors = rng.standard_normal((len(edges), 6))
    return [
        replace(
            edge,
            T_a_b=geometry.inverse(T_world[edge.a])
            @ T_world[edge.b]
            @ geometry.exp(np.linalg.solve(np.linalg.cholesky(edge.information).T, error)),
        )
        for edge, error in zip(edges, errors, strict=True)
    ]


def _median_chi2(edges: Sequence[Edge], values: gtsam.Values) -> float:
    """Median squared error; 1 without edges, and at least next to nothing."""
    return max(float(np.median(squared_errors(factor_graph(edges), values))), 1e-9) if edges else 1.0
