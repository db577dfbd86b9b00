"""Upright thin things, boxes, walls and the rest, told apart by what a grid of vertical columns holds.

A column is a square cell seen from above; what it holds at each height is one bit of a mask, so that whole
neighbourhoods are joined by `or` (as occupancy-grid pole extractors do: Schaefer et al., ECMR 2019).
"""

import numpy as np
from numba import njit

SLICE_M = 0.2
"""Chosen: height of one bit of a column, twice the vertical spacing of 64 beams at 10 m."""
NUM_SLICES = 32


@njit(cache=True, nogil=True)
def columns(cells, slices, side):
    """(side, side) uint32: bit s of a column is set where a point lies in slice s; what lies outside sets none."""
    masks = np.zeros((side, side), np.uint32)
    for k in range(len(cells)):
        i, j, s = cells[k, 0], cells[k, 1], slices[k]
        if 0 <= i < side and 0 <= j < side and 0 <= s < NUM_SLICES:
            masks[i, j] |= np.uint32(1) << np.uint32(s)
    return masks


@njit(cache=True, nogil=True)
def thin_uprights(masks, core, ring, band, min_slices, min_share):
    """(side, side) uint32: the bits of columns that belong to something thin, tall and free-standing.

    Around each occupied column the bits within `core` cells are joined, and those between `core` and `ring` cells
    away are taken off. What is left within `band` must span `min_slices` and be `min_share` of what was there.
    """
    side = masks.shape[0]
    marked = np.zeros_like(masks)
    inner, outer = _disc(core, -1), _disc(ring, core)
    for i in range(ring, side - ring):
        for j in range(ring, side - ring):
            if masks[i, j] & band == 0:
                continue
            held = _join(masks, inner, i, j) & band
            if _span(held) < min_slices:
                continue
            clear = held & ~_join(masks, outer, i, j)
            if _span(clear) >= min_slices and _count(clear) >= min_share * _count(held):
                for n in range(len(inner)):
                    marked[i + inner[n, 0], j + inner[n, 1]] |= clear
    return marked


@njit(cache=True, nogil=True)
def _disc(radius, inner_radius):
    """Offsets of the cells farther than `inner_radius` and at most `radius` cells from the middle."""
    offsets = np.empty(((2 * radius + 1) ** 2, 2), np.int64)
    count = 0
    for a in range(-radius, radius + 1):
        for b in range(-radius, radius + 1):
            squared = a * a + b * b
            if squared <= radius * radius and (inner_radius < 0 or squared > inner_radius * inner_radius):
                offsets[count, 0], offsets[count, 1] = a, b
                count += 1
    return offsets[:count]


@njit(cache=True, nogil=True)
def _join(masks, offsets, i, j):
    joined = np.uint32(0)
    for n in range(len(offsets)):
        joined |= masks[i + offsets[n, 0], j + offsets[n, 1]]
    return joined


@njit(cache=True, nogil=True)
def _count(mask):
    count = 0
    while mask:
        mask &= mask - np.uint32(1)
        count += 1
    return count


@njit(cache=True, nogil=True)
def _span(mask):
    """From the lowest to the highest bit set, both included."""
    if mask == 0:
        return 0
    low = 0
    while not (mask >> np.uint32(low)) & np.uint32(1):
        low += 1
    high = 31
    while not (mask >> np.uint32(high)) & np.uint32(1):
        high -= 1
    return high - low + 1
