"""Voxels of one tile: a mean point and intensity, how many points they stand for, and the class of most of them."""

import numpy as np

from segslam.points import hash_keys
from segslam.types import Indices

VOXEL = np.dtype([("point", "<f4", 3), ("count", "<u4"), ("label", "u1"), ("intensity", "<f4")])
"""`point` in metres: x and y from the tile's corner, z of the world."""
NUM_LABELS = 32
"""More than there are classes."""
MAX_HEIGHT_M = 2000.0
"""Of any point, above or below the start."""


def merged(voxels: np.ndarray, voxel_m: float) -> np.ndarray:
    """VOXEL rows with those of one cell made one: their mean by count, and the class with most points.

    Of classes with as many points the one with the lowest id. Cells are in the order in which they first occur.
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
    """0, 1, ... for each key in the order in which they first occur."""
    _, first = hash_keys(keys)
    is_first = first == np.arange(len(keys))
    return (np.cumsum(is_first) - 1)[first]


def _commonest_labels(cells: Indices, labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(num_cells,) uint8."""
    pairs = cells * NUM_LABELS + labels
    numbers = _numbered(pairs)
    counts = np.bincount(numbers, weights)
    _, first = np.unique(numbers, return_index=True)
    pair = pairs[first]
    cell, label = pair // NUM_LABELS, pair % NUM_LABELS
    order = np.lexsort((-label, counts, cell))
    last_of_cell = np.append(np.diff(cell[order]) > 0, True) if len(order) else np.zeros(0, bool)
    return label[order[last_of_cell]].astype(np.uint8)
