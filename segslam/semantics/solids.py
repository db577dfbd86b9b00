"""Pieces of what stands on the ground, seen from above, and how large each is."""

import numpy as np
from numba import njit

NO_PIECE = -1
RECTANGLE_STEP_DEG = 3.0
"""Chosen: a 5 m side is measured to within 1 cm."""


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
    """(num_pieces, 2) longer and shorter side, in cells, of the rectangle of least area around each piece."""
    angles = np.radians(np.arange(0.0, 90.0, RECTANGLE_STEP_DEG))
    cosines, sines = np.cos(angles), np.sin(angles)
    low = np.full((num_pieces, len(angles), 2), np.inf)
    high = np.full((num_pieces, len(angles), 2), -np.inf)
    for i in range(piece.shape[0]):
        for j in range(piece.shape[1]):
            k = piece[i, j]
            if k != NO_PIECE:
                for n in range(len(angles)):
                    u, v = cosines[n] * i + sines[n] * j, cosines[n] * j - sines[n] * i
                    low[k, n, 0], high[k, n, 0] = min(low[k, n, 0], u), max(high[k, n, 0], u)
                    low[k, n, 1], high[k, n, 1] = min(low[k, n, 1], v), max(high[k, n, 1], v)
    sides = np.empty((num_pieces, 2))
    for k in range(num_pieces):
        extents = high[k] - low[k] + 1.0  # a cell has a width
        best = np.argmin(extents[:, 0] * extents[:, 1])
        sides[k] = max(extents[best, 0], extents[best, 1]), min(extents[best, 0], extents[best, 1])
    return sides
