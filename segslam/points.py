"""Point clouds as arrays: in and out, no state."""

import numpy as np
from numba import njit

from segslam.types import Indices, Points

EMPTY = -1


def within_range(points: Points, min_m: float, max_m: float) -> np.ndarray:
    """(n,) bool: strictly farther than `min_m` and nearer than `max_m` from the origin; false for NaN."""
    squared = np.einsum("ij,ij->i", points, points)
    return (squared > min_m**2) & (squared < max_m**2)


def canonical_order(points: Points) -> Indices:
    """Indices that sort points along a skew direction: the same sequence of points whatever order they come in."""
    x, y, z = points.T.astype(np.float64)
    return np.argsort(x + np.sqrt(2.0) * y + np.sqrt(3.0) * z)


def voxel_first(points: Points, voxel_m: float) -> Indices:
    """Indices, ascending, of the first point in each occupied voxel. Raises ValueError if voxel_m <= 0."""
    keys = voxel_keys(points, voxel_m)
    return np.flatnonzero(hash_keys(keys)[1] == np.arange(len(keys)))


def voxel_means(points: Points, voxel_m: float) -> Points:
    """The mean of the points of each occupied voxel, float64, in the order of the voxels x, y, z.

    Raises ValueError if voxel_m <= 0.
    """
    _, voxel, counts = np.unique(voxel_keys(points, voxel_m), return_inverse=True, return_counts=True)
    sums = [np.bincount(voxel, weights=column, minlength=len(counts)) for column in points.T]
    return np.column_stack(sums) / counts[:, None]


def voxel_keys(points: Points, voxel_m: float) -> Indices:
    """One number a point, equal for two points exactly if they share a voxel; the voxel of a point is floor(p / voxel_m).

    Numbers grow with x, then y, then z. Raises ValueError if voxel_m <= 0.
    """
    if voxel_m <= 0:
        raise ValueError(f"voxel_m must be above 0, got {voxel_m}")
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=np.iinfo(np.int64).max)
    _, extent_y, extent_z = cells.max(axis=0, initial=0) + 1
    return (cells[:, 0] * extent_y + cells[:, 1]) * extent_z + cells[:, 2]


@njit("int64(int64, int64)", cache=True, nogil=True, inline="always")
def _home(key, size):
    return (key * 0x9E3779B97F4A7C1 >> 20) & (size - 1)


@njit("Tuple((int64[:], int64[:]))(int64[:])", cache=True, nogil=True)
def hash_keys(keys):
    """An open-addressing table for `find_key`, and for each row the first row with the same key.

    A slot of the table holds the first row of its key, or EMPTY.
    """
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, EMPTY, np.int64)
    first = np.empty(len(keys), np.int64)
    for row in range(len(keys)):
        slot = _home(keys[row], size)
        while table[slot] != EMPTY and keys[table[slot]] != keys[row]:
            slot = (slot + 1) & (size - 1)
        if table[slot] == EMPTY:
            table[slot] = row
        first[row] = table[slot]
    return table, first


@njit("int64(int64[:], int64[:], int64)", cache=True, nogil=True)
def find_key(table, keys, key):
    """The first row of `keys` that equals `key`, or EMPTY; `table` is that of `hash_keys(keys)`."""
    slot = _home(key, len(table))
    while table[slot] != EMPTY and keys[table[slot]] != key:
        slot = (slot + 1) & (len(table) - 1)
    return table[slot]
