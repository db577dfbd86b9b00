"""Boxes and walls: what stands on the ground as a piece of a car's size, and what is flat and vertical."""

import numpy as np
from numba import njit

NO_PIECE = -1


@njit(cache=True, nogil=True)
def pieces(occupied):
    """(side, side) int64: which connected piece (8 neighbours) a cell belongs to, NO_PIECE where it is empty."""
    side = occupied.shape[0]
    piece = np.full((side, side), NO_PIECE, np.int64)
    stack = np.empty((side * side, 2), np.int64)
    num_pieces = 0
    for i in range(side):
        for j in range(side):
            if not occupied[i, j] or piece[i, j] != NO_PIECE:
                continue
            piece[i, j] = num_pieces
            stack[0] = i, j
            top = 1
            while top > 0:
                top -= 1
                a, b = stack[top, 0], stack[top, 1]
                for u in range(max(a - 1, 0), min(a + 2, side)):
                    for v in range(max(b - 1, 0), min(b + 2, side)):
                        if occupied[u, v] and piece[u, v] == NO_PIECE:
                            piece[u, v] = num_pieces
                            stack[top] = u, v
                            top += 1
            num_pieces += 1
    return piece


@njit(cache=True, nogil=True)
def tightest_rectangles(piece, num_pieces):
    """(num_pieces, 2) length and width, in cells, of the rectangle of least area around each piece; 3-degree steps."""
    angles = np.arange(0.0, 90.0, 3.0) * np.pi / 180.0
    low = np.full((num_pieces, len(angles), 2), np.inf)
    high = np.full((num_pieces, len(angles), 2), -np.inf)
    for i in range(piece.shape[0]):
        for j in range(piece.shape[1]):
            k = piece[i, j]
            if k == NO_PIECE:
                continue
            for n in range(len(angles)):
                c, s = np.cos(angles[n]), np.sin(angles[n])
                u, v = c * i + s * j, c * j - s * i
                low[k, n, 0], high[k, n, 0] = min(low[k, n, 0], u), max(high[k, n, 0], u)
                low[k, n, 1], high[k, n, 1] = min(low[k, n, 1], v), max(high[k, n, 1], v)
    sizes = np.empty((num_pieces, 2))
    for k in range(num_pieces):
        best = np.inf
        for n in range(len(angles)):
            a, b = high[k, n, 0] - low[k, n, 0] + 1.0, high[k, n, 1] - low[k, n, 1] + 1.0
            if a * b < best:
                best = a * b
                sizes[k] = max(a, b), min(a, b)
    return sizes


@njit(cache=True, nogil=True)
def wall_voxels(cells, layers, offsets_mm, shape, thickness_mm, min_length_mm, min_points):
    """(layers, side, side) bool: voxels whose points, with those of the 8 around, lie along one line seen from above.

    `offsets_mm` (n, 2) are whole millimetres from the grid's corner, so that sums do not depend on the points' order.
    """
    num_layers, side, _ = shape
    moments = np.zeros((num_layers, side, side, 6), np.int64)
    for k in range(len(cells)):
        x, y = offsets_mm[k, 0], offsets_mm[k, 1]
        m = moments[layers[k], cells[k, 0], cells[k, 1]]
        m[0] += 1
        m[1] += x
        m[2] += y
        m[3] += x * x
        m[4] += x * y
        m[5] += y * y
    flat = np.zeros((num_layers, side, side), np.bool_)
    for layer in range(num_layers):
        for i in range(1, side - 1):
            for j in range(1, side - 1):
                if moments[layer, i, j, 0] > 0:
                    flat[layer, i, j] = _is_line(
                        moments[layer, i - 1 : i + 2, j - 1 : j + 2], thickness_mm, min_length_mm, min_points
                    )
    return flat


@njit(cache=True, nogil=True)
def _is_line(moments, thickness_mm, min_length_mm, min_points):
    n, x, y, xx, xy, yy = 0, 0, 0, 0, 0, 0
    for i in range(moments.shape[0]):
        for j in range(moments.shape[1]):
            m = moments[i, j]
            n, x, y, xx, xy, yy = n + m[0], x + m[1], y + m[2], xx + m[3], xy + m[4], yy + m[5]
    if n < min_points:
        return False
    a, b, c = xx / n - (x / n) ** 2, xy / n - (x / n) * (y / n), yy / n - (y / n) ** 2
    middle, spread = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
    return middle - spread < thickness_mm**2 and middle + spread > min_length_mm**2
