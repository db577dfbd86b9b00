"""Alignment of two submaps: point to plane, robust against surfaces that only one of them contains.

Each point of the source is paired with the nearest point of the target. Its squared distance to the plane there counts
under the Geman-McClure kernel, which is wide at first and then as wide as surfaces are rough.

No rigid motion aligns distorted clouds, unless both have the same distortion. It is a further unknown of their
alignment (Gauss and Newton, one step from the best pose), and how much the pairs differ tells its error. In pairs
that are aligned with the distortion, a part of it does not show.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from segslam.core import geometry
from segslam.core.kernels import kernel
from segslam.core.processes import in_parts
from segslam.core.trajectory import Poses
from segslam.core.types import Information, Points, Transform, Vector
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
LEAST_VARIANCE = float(np.finfo(float).eps)
"""Residuals (m^2) of made scenes without any noise are 0; the information of an alignment remains finite."""
PointsOf = Callable[[int], Points]
"""Returns the points of a keyframe, by id, in its own frame."""
Corrects = Callable[[int, Points], Float[np.ndarray, "m n 3"]]
"""By how much points (n, 3) of a keyframe move if each of m alternative corrections grows by one."""
MIN_PAIRS = 8
"""Chosen: the scatter of fewer pairs is too uncertain."""
MOST_PAIRS = 60
"""Chosen: number of pairs of keyframes that are measured each time, for a correction or a thickness. The vertical angle
of KITTI 00 then scatters by 0.01 degrees."""


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
    points, normals = _sample(source)
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
    return Alignment(T_target_source, hessian / max(squares / weights, LEAST_VARIANCE), num / len(points))


def _sample(source: LightSurface) -> tuple[Points, Points]:
    """At most `MOST_POINTS` points of a surface, and their normals."""
    rows = np.arange(0, len(source), max(1, -(-len(source) // MOST_POINTS)))
    return source.points[rows], source.normals_at(rows)


class Shown(NamedTuple):
    """What pairs of clouds show of each of m alternative corrections."""

    value: Vector
    sigma: Vector
    """Standard deviations of the values, by how much the pairs differ."""
    gain: Vector
    """By how much each raises the log-likelihood of the pairs."""
    num_pairs: int


def shown(
    pairs: Sequence[tuple[int, int]], surface_of: Callable[[int], LightSurface], T_world: Poses, corrects: Corrects
) -> Shown | None:
    """The corrections by all pairs (target, source); None if fewer than `MIN_PAIRS` are aligned, or none can be seen.

    `T_world` (n, 4, 4): poses of the keyframes.
    """

    def by_pair(part: Sequence[tuple[int, int]]) -> Iterator[Float[np.ndarray, "2 m"] | None]:
        for ids in part:
            target, source = map(surface_of, ids)
            aligned = align(source, target, geometry.inverse(T_world[ids[0]]) @ T_world[ids[1]])
            yield None if aligned is None else _of_pair(ids, source, target, aligned.T_target_source, corrects)

    found = [one for one in in_parts(pairs, by_pair) if one is not None]
    if len(found) < MIN_PAIRS:
        return None
    gradients, curvatures = np.array(found).transpose(1, 0, 2)
    total = curvatures.sum(axis=0)
    if not (total > 0.0).all():
        return None
    value = gradients.sum(axis=0) / total
    sigma = np.sqrt(np.sum((gradients - value * curvatures) ** 2, axis=0)) / total
    return Shown(value, sigma, value**2 * total / 2.0, len(found))


def _of_pair(
    ids: tuple[int, int], source: LightSurface, target: LightSurface, T_target_source: Transform, corrects: Corrects
) -> Float[np.ndarray, "2 m"]:
    """Gradient and curvature of a pair's likelihood by each correction; points are paired as in the last alignment."""
    p, own_normals = _sample(source)
    moved = geometry.apply(T_target_source, p)
    nearest, distance_m = target.nearest(moved)
    normals = target.normals_at(nearest)
    normals_source = normals @ T_target_source[:3, :3]
    same = np.abs(np.einsum("ij,ij->i", normals_source, own_normals)) >= SAME_NORMAL
    rows = np.flatnonzero(same & (distance_m < SEARCH_M[-1]))
    p, q, normals, normals_source = p[rows], target.points[nearest[rows]], normals[rows], normals_source[rows]
    residual_m = np.einsum("ij,ij->i", moved[rows] - q, normals)
    weights = (1.0 + (residual_m / KERNEL_M[-1]) ** 2) ** -2
    pose = np.column_stack([np.cross(p, normals_source), normals_source])
    columns = np.einsum("mij,ij->im", corrects(ids[1], p), normals_source)
    columns -= np.einsum("mij,ij->im", corrects(ids[0], q), normals)
    weighted = pose.T * weights
    coupling = weighted @ columns
    poses = np.linalg.lstsq(weighted @ pose, np.column_stack([weighted @ residual_m, coupling]))[0]
    gradient = coupling.T @ poses[:, 0] - columns.T @ (weights * residual_m)
    curvature = weights @ columns**2 - np.einsum("ij,ij->j", coupling, poses[:, 1:])
    variance = float(weights @ residual_m**2 / weights.sum())
    return np.array([gradient, curvature]) / max(variance, LEAST_VARIANCE)


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
