"""Detection of thin vertical objects in a grid of vertical columns.

A column is a square cell of the x-y plane. A bit mask holds its occupied height slices, so that neighbourhoods are
combined by bitwise operations. A pole is an object with free space all around, as in occupancy-grid pole extractors
(Schaefer, Büscher, Vertens, Luft, Burgard, "Long-term urban vehicle localization using pole landmarks extracted from
3-D lidar scans", ECMR 2019).
"""

import numpy as np

from segslam.core.kernels import kernel

NUM_SLICES = 16


@kernel("boolean[::1](int64[:, ::1], int64[::1], UniTuple(int64, 2), int64, int64, int64, float64)")
def on_thin_uprights(cells, slices, shape, core, ring, min_slices, min_share):
    """(n,) bool: whether each point belongs to a thin, tall, free-standing object.

    Point k lies in column `cells[k]` of a grid of the given shape, in height slice `slices[k]`. For each occupied
    column: combine the slices occupied within `core` cells, and remove those occupied between `core` and `ring` cells
    away. The remaining slices must span `min_slices` and be a share `min_share` of the slices before removal. Points
    outside the grid or the slices 0 to NUM_SLICES - 1 are ignored, as are columns within `ring` cells of the border.
    """
    masks, thin = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
    for k in range(len(cells)):
        if _takes_part(cells[k], slices[k], shape):
            masks[cells[k, 0], cells[k, 1]] |= np.uint16(1 << slices[k])
    inner, outer = _disc(core, -1), _disc(ring, core)
    for i in range(ring, shape[0] - ring):
        for j in range(ring, shape[1] - ring):
            if masks[i, j] == 0:
                continue
            held = _joined(masks, inner, i, j)
            if _span(held) < min_slices:
                continue
            clear = _left_clear(masks, outer, i, j, held, min_share * _count(held))
            if _span(clear) >= min_slices:
                for n in range(len(inner)):
                    thin[i + inner[n, 0], j + inner[n, 1]] |= np.uint16(clear)
    chosen = np.zeros(len(cells), np.bool_)
    for k in range(len(cells)):
        if _takes_part(cells[k], slices[k], shape):
            chosen[k] = thin[cells[k, 0], cells[k, 1]] >> slices[k] & 1
    return chosen


@kernel("boolean(int64[::1], int64, UniTuple(int64, 2))")
def _takes_part(cell, slice_index, shape):
    return 0 <= cell[0] < shape[0] and 0 <= cell[1] < shape[1] and 0 <= slice_index < NUM_SLICES


@kernel("int64[:, ::1](int64, int64)")
def _disc(radius, inner_radius):
    """Offsets of the cells farther than `inner_radius` and at most `radius` cells from the centre."""
    offsets = np.empty(((2 * radius + 1) ** 2, 2), np.int64)
    count = 0
    for a in range(-radius, radius + 1):
        for b in range(-radius, radius + 1):
            squared = a * a + b * b
            if squared <= radius * radius and (inner_radius < 0 or squared > inner_radius * inner_radius):
                offsets[count, 0], offsets[count, 1] = a, b
                count += 1
    return offsets[:count]


@kernel("int64(uint16[:, ::1], int64[:, ::1], int64, int64)")
def _joined(masks, offsets, i, j):
    joined = 0
    for n in range(len(offsets)):
        joined |= masks[i + offsets[n, 0], j + offsets[n, 1]]
    return joined


@kernel("int64(uint16[:, ::1], int64[:, ::1], int64, int64, int64, float64)")
def _left_clear(masks, offsets, i, j, held, min_count):
    """The bits of `held` that no surrounding column contains; 0 if fewer than `min_count` remain."""
    clear = held
    for n in range(len(offsets)):
        taken = clear & masks[i + offsets[n, 0], j + offsets[n, 1]]
        if taken:
            clear ^= taken
            if _count(clear) < min_count:
                return 0
    return clear


@kernel("int64(int64)")
def _count(mask):
    count = 0
    while mask:
        mask &= mask - 1
        count += 1
    return count


@kernel("int64(int64)")
def _span(mask):
    """Number of bits from the lowest to the highest set bit, both included."""
    first, last = NUM_SLICES, -1
    for bit in range(NUM_SLICES):
        if mask >> bit & 1:
            first, last = min(first, bit), bit
    return max(last - first + 1, 0)
