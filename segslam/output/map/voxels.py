"""Voxels of one tile: mean point and intensity, number of points, and most frequent class."""

import numpy as np

from segslam.core.points import hash_keys
from segslam.core.types import Indices

VOXEL = np.dtype([("point", "<f4", 3), ("count", "<u4"), ("label", "u1"), ("intensity", "<f4")])
"""`point` (m): x and y from the corner of the tile, z in the world."""
NUM_LABELS = 32
"""Larger than the number of classes."""
MAX_HEIGHT_M = 2000.0
"""Largest height of a point, above or below the origin."""


def merged(voxels: np.ndarray, voxel_m: float) -> np.ndarray:
    """VOXEL rows, merged to one row per cell: means weighted by count, and the class with the most points.

    Ties between classes are resolved to the smallest id. Cells are in the order of their first occurrence.
    """
    keys = _cell_keys(voxels["point"], voxel_m)
    cells = _numbered(keys)
    num_cells = int(cells.max()) + 1 if len(cells) else 0
    result = np.zeros(num_cells, VOXEL)
    weights = voxels["count"].astype(np.float64)
    counts = np.bincount(cells, weights, minlength=num_cells)
    means = [*result["point"].T, result["intensity"]]
    for mean, values in zip(means, [*voxels["point"].T, voxels["intensity"]], strict=True):
        mean[:] = np.bincount(cells, weights * values, minlength=num_cells) / np.maximum(counts, 1)
    result["count"] = counts
    result["label"] = _commonest_labels(cells, voxels["label"], weights)
    return result


def _cell_keys(points: np.ndarray, voxel_m: float) -> Indices:
    """A number for each point's cell, floor(p / voxel_m); tiles are less than 2^20 cells wide."""
    x, y = (np.floor(points[:, axis] / voxel_m).astype(np.int64) + 1 for axis in range(2))  # -1 by rounding at a border
    z = np.floor((points[:, 2] + MAX_HEIGHT_M) / voxel_m).astype(np.int64)
    return (x << 42) | (y << 21) | z


def _numbered(keys: Indices) -> Indices:
    """0, 1, ... for each key, in the order of first occurrence."""
    _, first = hash_keys(keys)
    is_first = first == np.arange(len(keys))
    return (np.cumsum(is_first) - 1)[first]


def _commonest_labels(cells: Indices, labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(num_cells,) uint8 label with the largest weight in each cell."""
    pairs = cells * NUM_LABELS + labels
    numbers = _numbered(pairs)
    counts = np.bincount(numbers, weights)
    _, first = np.unique(numbers, return_index=True)
    pair = pairs[first]
    cell, label = pair // NUM_LABELS, pair % NUM_LABELS
    order = np.lexsort((-label, counts, cell))
    last_of_cell = np.append(np.diff(cell[order]) > 0, True) if len(order) else np.zeros(0, bool)
    return label[order[last_of_cell]].astype(np.uint8)
