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
from segslam.core.types import Points, Vector
from segslam.registration.refinement import LightSurface
from segslam.slam.adjustment.alignment import align, pairs_of

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
    for target, source in pairs:
        clouds = surface_of(source), surface_of(target)
        aligned = align(*clouds, geometry.inverse(T_world[target]) @ T_world[source])
        if aligned is None:
            continue
        matched = pairs_of(*clouds, aligned.T_target_source)
        pose = np.column_stack([np.cross(matched.source, matched.normals_source), matched.normals_source])
        columns = np.einsum("mij,ij->im", corrects(source, matched.source), matched.normals_source)
        columns -= np.einsum("mij,ij->im", corrects(target, matched.target), matched.normals)
        weighted = pose.T * matched.weights
        coupling = weighted @ columns
        poses = np.linalg.lstsq(weighted @ pose, np.column_stack([weighted @ matched.residual_m, coupling]))[0]
        gradient = coupling.T @ poses[:, 0] - columns.T @ (matched.weights * matched.residual_m)
        curvature = matched.weights @ columns**2 - np.einsum("ij,ij->j", coupling, poses[:, 1:])
        variance = float(matched.weights @ matched.residual_m**2 / matched.weights.sum())
        found.append(np.array([gradient, curvature]) / variance)
    if len(found) < MIN_PAIRS:
        return None
    gradients, curvatures = np.array(found).transpose(1, 0, 2)
    total = curvatures.sum(axis=0)
    if not (total > 0.0).all():
        return None
    value = gradients.sum(axis=0) / total
    sigma = np.sqrt(np.sum((gradients - value * curvatures) ** 2, axis=0)) / total
    return Shown(value, sigma, value**2 * total / 2.0, len(found))
