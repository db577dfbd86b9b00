"""Height of the ground below points."""

import numpy as np
from scipy.ndimage import distance_transform_edt

from segslam.core.types import Points, Vector

OBSTACLE_M = (0.3, 2.0)
"""Chosen: heights above the ground where a voxel is an obstacle (m)."""

GROUND_CELL_M = 2.0


def lowest_ground(points: Points, ground: Points, side_m: float) -> Vector:
    """Height (n,) of the ground (m) below each point: the lowest point of `ground` in its cell, or in the nearest cell.

    All points lie within a square of `side_m`, with x and y measured from its corner.
    """
    size = round(side_m / GROUND_CELL_M)
    lowest = np.full((size, size), np.inf)
    np.minimum.at(lowest, _cells(ground, size), ground[:, 2])
    nearest = distance_transform_edt(np.isinf(lowest), return_distances=False, return_indices=True)
    return lowest[tuple(nearest)][_cells(points, size)]


def _cells(points: Points, size: int) -> tuple[np.ndarray, np.ndarray]:
    column, row = np.clip((points[:, :2] / GROUND_CELL_M).astype(np.int64), 0, size - 1).T
    return column, row
