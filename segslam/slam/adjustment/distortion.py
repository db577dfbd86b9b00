"""Distortion of scans: what pairs of clouds show of it, which see the same surfaces from different places.

No rigid motion aligns distorted clouds, unless both have the same distortion. It is a further unknown of their
registration (Gauss and Newton, one step from the best pose), and how much the pairs differ tells its error. In pairs
that are aligned with the distortion, a part of it does not show.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Points, Transform, Vector
from segslam.registration.refinement import LightSurface
from segslam.slam.adjustment.alignment import KERNEL_M, SAME_NORMAL, SEARCH_M, align, sample

PointsOf = Callable[[int], Points]
"""Returns the points of a keyframe, by id, in its own frame."""
Corrects = Callable[[int, Points], Float[np.ndarray, "m n 3"]]
"""By how much points (n, 3) of a keyframe move if each of m alternative corrections grows by one."""
MIN_PAIRS = 8
"""Chosen: the scatter of fewer pairs is too uncertain."""
MOST_PAIRS = 40
"""Chosen: number of pairs measured each time, in a second."""


class Shown(NamedTuple):
    """What pairs of clouds show of each of m alternative corrections."""

    value: Vector
    sigma: Vector
    """Standard deviations of the values, by how much the pairs differ."""
    gain: Vector
    """By how much each raises the log-likelihood of the pairs."""
    num_pairs: int


def shown(
    pairs: Iterable[tuple[int, int]], surface_of: Callable[[int], LightSurface], T_world: Poses, corrects: Corrects
) -> Shown | None:
    """The corrections by all pairs (target, source); None if fewer than `MIN_PAIRS` are aligned, or none can be seen.

    `T_world` (n, 4, 4): poses of the keyframes.
    """
    found = []
    for ids in pairs:
        target, source = map(surface_of, ids)
        aligned = align(source, target, geometry.inverse(T_world[ids[0]]) @ T_world[ids[1]])
        if aligned is not None:
            found.append(_of_pair(ids, source, target, aligned.T_target_source, corrects))
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
    p, own_normals = sample(source)
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
    return np.array([gradient, curvature]) / float(weights @ residual_m**2 / weights.sum())
