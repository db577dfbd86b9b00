"""Alignment of two submaps: point to plane, robust against surfaces that only one of them contains.

Each point of the source is paired with the nearest point of the target. Its squared distance to the plane there counts
under the Geman-McClure kernel, which is wide at first and then as wide as surfaces are rough.
"""

from dataclasses import dataclass

import numpy as np

from segslam.core import geometry
from segslam.core.kernels import kernel
from segslam.core.types import Information, Points, Transform
from segslam.registration.refinement import LightSurface

SEARCH_M = (1.0, 0.8, 0.7)
"""Chosen: search distance of each iteration, the last one for all others; odometry errs by less over 30 m."""
KERNEL_M = (0.6, 0.4, 0.25, 0.15)
"""Chosen on KITTI 00: distance to a plane at which the weight of a point is a quarter, for each iteration."""
SAME_NORMAL = 0.9
"""Chosen: smallest cosine between the normals of a pair; others are edges and foliage."""
CONVERGED = 1e-3
"""Chosen: the iteration ends after a step smaller than this (rad, m), below the noise of an alignment."""
SETTLED = 1e-2
"""Chosen: an alignment whose last step is larger did not converge (rad, m)."""
MOST_POINTS = 3000
"""Chosen: number of points of the source, evenly among all."""
MIN_PAIRED = 100
"""Chosen: fewer pairs of points do not determine a pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The pose of one submap in another."""

    T_target_source: Transform
    information: Information
    """Inverse covariance for independent errors of the points."""
    overlap: float
    """Share of the source's points that are paired."""


def align(source: LightSurface, target: LightSurface, T_target_source: Transform) -> Alignment | None:
    """The pose that aligns source and target near an initial guess; None if it does not converge."""
    if min(len(source), len(target)) < MIN_PAIRED:
        return None
    points, normals = sample(source)
    for iteration in range(20):
        nearest, distance_m = target.nearest(geometry.apply(T_target_source, points))
        paired = distance_m < SEARCH_M[min(iteration, len(SEARCH_M) - 1)]
        rows = nearest[paired]
        hessian, gradient, squares, weights, num = _normal_equations(
            points[paired],
            normals[paired],
            target.points[rows],
            target.normals_at(rows),
            np.ascontiguousarray(T_target_source),
            KERNEL_M[min(iteration, len(KERNEL_M) - 1)],
        )
        if num < MIN_PAIRED or weights == 0.0:
            return None
        step = -np.linalg.lstsq(hessian, gradient)[0]
        length = float(np.linalg.norm(step))
        T_target_source = T_target_source @ geometry.exp(step)
        if length < CONVERGED and iteration >= len(KERNEL_M) - 1:
            break
    if length > SETTLED:
        return None
    return Alignment(T_target_source, hessian / (squares / weights), num / len(points))


def sample(source: LightSurface) -> tuple[Points, Points]:
    """At most `MOST_POINTS` points of a surface, and their normals."""
    rows = np.arange(0, len(source), max(1, -(-len(source) // MOST_POINTS)))
    return source.points[rows], source.normals_at(rows)


@kernel(
    "Tuple((float64[:, ::1], float64[::1], float64, float64, int64))(float64[:, :], float64[:, :], "
    "float64[:, :], float64[:, :], float64[:, ::1], float64)"
)
def _normal_equations(source, normals, target, target_normals, T, width):
    """Hessian and gradient of half the weighted squares of pairs by the pose; weighted squares, weights, pairs used."""
    hessian, gradient, row = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    squares = weights = 0.0
    num = 0
    for k in range(len(source)):
        n, m, p = target_normals[k], normals[k], source[k]
        a = T[0, 0] * n[0] + T[1, 0] * n[1] + T[2, 0] * n[2]  # the normal in the source's frame
        b = T[0, 1] * n[0] + T[1, 1] * n[1] + T[2, 1] * n[2]
        c = T[0, 2] * n[0] + T[1, 2] * n[1] + T[2, 2] * n[2]
        if abs(a * m[0] + b * m[1] + c * m[2]) < SAME_NORMAL:
            continue
        e = a * p[0] + b * p[1] + c * p[2]
        for i in range(3):
            e += n[i] * (T[i, 3] - target[k, i])
        row[0], row[1], row[2] = p[1] * c - p[2] * b, p[2] * a - p[0] * c, p[0] * b - p[1] * a
        row[3], row[4], row[5] = a, b, c
        w = (1.0 + (e / width) ** 2) ** -2.0
        for i in range(6):
            gradient[i] += w * e * row[i]
            for k2 in range(6):
                hessian[i, k2] += w * row[i] * row[k2]
        squares += w * e * e
        weights += w
        num += 1
    return hessian, gradient, squares, weights, num
