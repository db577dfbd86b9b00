"""Pieces of what stands on the ground, seen from above, and how large each is."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from segslam.semantics.cells import cells_above
from segslam.types import Indices, Mask, Points, Vector

CELL_M = 0.3
"""Chosen: things nearer to each other than this are one piece."""
NO_PIECE = -1
RECTANGLE_STEP_DEG = 5.0
"""Chosen: the short side of a car comes out at most 20 cm too long."""


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Connected cells seen from above. All but `of_point` have a row a piece and count only points that make it."""

    of_point: Indices
    """The piece that a point stands in, NO_PIECE if in none; also of points that did not help to make it."""
    num_points: Indices
    top_m: Vector
    """Height above the ground of the highest point."""
    length_m: Vector
    """Longer side of the rectangle of least area around its points, seen from above."""
    width_m: Vector


def pieces(points: Points, heights: Vector, chosen: Mask) -> Pieces:
    """The pieces that the chosen points of a level cloud make."""
    cells, _, shape = cells_above(points, CELL_M, border=1)
    grid, num_pieces = _connected(cells, chosen, shape)
    of_point = grid[cells[:, 0], cells[:, 1]]
    num_points, top_m = _counts_and_tops(of_point, heights, chosen, num_pieces)
    sides_m = _tightest_rectangles(points, of_point, chosen, num_pieces)
    return Pieces(of_point, num_points, top_m, sides_m[:, 0], sides_m[:, 1])


@njit(cache=True, nogil=True)
def _connected(cells, chosen, shape):
    """The piece (8 neighbours) of each cell of a grid, NO_PIECE where no chosen point lies, and how many there are."""
    unseen = np.zeros(shape, np.bool_)
    for k in range(len(cells)):
        if chosen[k]:
            unseen[cells[k, 0], cells[k, 1]] = True
    grid = np.full(shape, NO_PIECE, np.int32)
    num_pieces = 0
    for i in range(shape[0]):
        for j in range(shape[1]):
            if unseen[i, j]:
                _fill(grid, unseen, i, j, num_pieces)
                num_pieces += 1
    return grid, num_pieces


@njit(cache=True, nogil=True)
def _fill(grid, unseen, i, j, number):
    unseen[i, j] = False
    stack = [(i, j)]
    while stack:
        i, j = stack.pop()
        grid[i, j] = number
        for a in range(i - 1, i + 2):  # never outside: the border is empty
            for b in range(j - 1, j + 2):
                if unseen[a, b]:
                    unseen[a, b] = False
                    stack.append((a, b))


@njit(cache=True, nogil=True)
def _counts_and_tops(piece, heights, chosen, num_pieces):
    counts = np.zeros(num_pieces, np.int64)
    tops = np.full(num_pieces, -np.inf)
    for k in range(len(piece)):
        if chosen[k]:
            counts[piece[k]] += 1
            tops[piece[k]] = max(tops[piece[k]], heights[k])
    return counts, tops


@njit(cache=True, nogil=True)
def _tightest_rectangles(points, piece, chosen, num_pieces):
    """(num_pieces, 2) longer and shorter side (m) of the rectangle of least area around each piece, from above."""
    angles = np.radians(np.arange(0.0, 90.0, RECTANGLE_STEP_DEG))
    cosines, sines = np.cos(angles), np.sin(angles)
    low = np.full((num_pieces, len(angles), 2), np.inf)
    high = np.full((num_pieces, len(angles), 2), -np.inf)
    for k in range(len(points)):
        if chosen[k]:
            lows, highs = low[piece[k]], high[piece[k]]
            for n in range(len(angles)):
                u = cosines[n] * points[k, 0] + sines[n] * points[k, 1]
                v = cosines[n] * points[k, 1] - sines[n] * points[k, 0]
                lows[n, 0], highs[n, 0] = min(lows[n, 0], u), max(highs[n, 0], u)
                lows[n, 1], highs[n, 1] = min(lows[n, 1], v), max(highs[n, 1], v)
    sides = np.empty((num_pieces, 2))
    for k in range(num_pieces):
        extents = high[k] - low[k]
        best = np.argmin(extents[:, 0] * extents[:, 1])
        sides[k] = max(extents[best, 0], extents[best, 1]), min(extents[best, 0], extents[best, 1])
    return sides
