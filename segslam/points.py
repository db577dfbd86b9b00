"""Point clouds as arrays: in and out, no state."""

import numpy as np
from numba import njit

from segslam.types import Indices, Points


def within_range(points: Points, min_m: float, max_m: float) -> np.ndarray:
    """(n,) bool: strictly farther than `min_m` and nearer than `max_m` from the origin; false for NaN."""
    squared = np.einsum("ij,ij->i", points, points)
    return (squared > min_m**2) & (squared < max_m**2)


def voxel_first(points: Points, voxel_m: float) -> Indices:
    """Indices, ascending, of the first point in each occupied voxel. Raises ValueError if voxel_m <= 0."""
    if voxel_m <= 0:
        raise ValueError(f"voxel_m must be above 0, got {voxel_m}")
    keys = np.floor(points / voxel_m).astype(np.int64)
    return np.sort(_first_of_each(keys[:, 0] * 73856093 ^ keys[:, 1] * 19349669 ^ keys[:, 2] * 83492791, keys))


@njit("int64[:](int64[:], int64[:, :])", cache=True)
def _first_of_each(hashes, keys):
    """Open addressing: the first row of each distinct key."""
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, -1, np.int64)
    kept = np.empty(len(keys), np.int64)
    num_kept = 0
    for row in range(len(keys)):
        slot = (hashes[row] * 0x9E3779B97F4A7C1 >> 20) & (size - 1)
        while table[slot] >= 0:
            other = table[slot]
            if keys[other, 0] == keys[row, 0] and keys[other, 1] == keys[row, 1] and keys[other, 2] == keys[row, 2]:
                break
            slot = (slot + 1) & (size - 1)
        else:
            table[slot] = row
            kept[num_kept] = row
            num_kept += 1
    return kept[:num_kept]
