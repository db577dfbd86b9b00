"""Residuals that the points of a patch have in common.

Noise differs from point to point and vanishes in the mean of a patch. At a wrong pose whole surfaces are displaced,
however noisy the sensor: the recess of a door coincides with a wall.
"""

import numpy as np

from segslam.core.points import cell_keys
from segslam.core.types import Points, Vector

PATCH_M = 1.5
"""Chosen on simulated corridors, seed 2: of patches of 0.6, 1.0, 1.5 and 2.0 m these separate wrong poses best."""
MIN_POINTS = 4
"""Number of points of a patch whose variance is meaningful."""


def common_residual_m(points: Points, normals: Points, residuals_m: Vector) -> float:
    """Root mean square of the mean residuals of patches, without the part that the scatter within them explains (m).

    `points` (n, 3) in the sensor's frame, with unit normals (n, 3) of either sign and distances (n,) along them to
    another surface. A patch has the points of a cube of `PATCH_M` whose normals have the same largest component. 0 if
    no patch has enough points.
    """
    away = np.einsum("ij,ij->i", normals, points) > 0
    behind_m = np.where(away, residuals_m, -residuals_m)
    keys, _ = cell_keys(points, PATCH_M)
    _, patch = np.unique(3 * keys + np.abs(normals).argmax(axis=1), return_inverse=True)
    count = np.bincount(patch)
    is_full = count >= MIN_POINTS
    if not is_full.any():
        return 0.0
    mean, squared = (np.bincount(patch, weights)[is_full] / count[is_full] for weights in (behind_m, behind_m**2))
    count = count[is_full]
    of_mean = (squared - mean**2) / (count - 1)
    return float(np.sqrt(max(np.average(mean**2 - of_mean, weights=count), 0.0)))
