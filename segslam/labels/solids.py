"""Segments of the objects above the ground, as connected cells of the x-y plane, and their sizes."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

from segslam.core.kernels import kernel
from segslam.core.types import IndexPairs, Indices, Mask, Points, Vector

CELL_M = 0.3
"""Chosen: objects nearer to each other than this form one segment."""
NO_PIECE = -1
RECTANGLE_STEP_DEG = 5.0
"""Chosen: angle steps for which the short side of a car is overestimated by at most 20 cm."""
_ANGLES = np.radians(np.arange(0.0, 90.0, RECTANGLE_STEP_DEG))
DIRECTIONS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Segments of connected cells. All fields but `of_point` have one row per segment, from its chosen points."""

    of_point: Indices
    """(n,) segment of each point, also of points that were not chosen; NO_PIECE if it has none."""
    num_points: Indices
    top_m: Vector
    """Height of the highest point above the ground."""
    length_m: Vector
    """Longer side of the smallest-area bounding rectangle in the x-y plane."""
    width_m: Vector


def pieces(points: Points, heights: Vector, chosen: Mask) -> Pieces:
    """The segments of the chosen points of a level cloud."""
    cells, _, shape = grid_cells(points, CELL_M, border=1)
    occupied = np.zeros(shape, bool)
    occupied[cells[chosen, 0], cells[chosen, 1]] = True
    grid, num_pieces = label(occupied, structure=np.ones((3, 3), bool))
    of_point = grid[cells[:, 0], cells[:, 1]].astype(np.int64) + NO_PIECE  # labels start at 1; 0 is the background
    num_points = np.bincount(of_point[chosen], minlength=num_pieces)
    top_m = np.full(num_pieces, -np.inf)
    np.maximum.at(top_m, of_point[chosen], heights[chosen])
    sides_m = _tightest_rectangles(points, of_point, chosen, num_pieces, DIRECTIONS)
    return Pieces(of_point, num_points, top_m, sides_m[:, 0], sides_m[:, 1])


def grid_cells(points: Points, cell_m: float, *, border: int) -> tuple[IndexPairs, Vector, tuple[int, int]]:
    """The cell (n, 2) of each point, the corner of the grid (m), and the number of rows and columns.

    The grid contains all points and a margin of `border` empty cells.
    """
    whole = [np.floor(points[:, axis] / cell_m) for axis in (0, 1)]
    first = np.array([column.min() if len(points) else 0.0 for column in whole]) - border
    cells = np.column_stack([column - start for column, start in zip(whole, first, strict=True)]).astype(np.int64)
    rows, columns = (int(cells[:, axis].max(initial=0)) + border + 1 for axis in (0, 1))
    return cells, first * cell_m, (rows, columns)


@kernel("float64[:, ::1](float64[:, ::1], int64[::1], boolean[::1], int64, float64[:, ::1])")
def _tightest_rectangles(points, piece, chosen, num_pieces, directions):
    """(num_pieces, 2) longer and shorter side (m) of the smallest-area bounding rectangle of each segment."""
    low = np.full((num_pieces, len(directions), 2), np.inf)
    high = np.full((num_pieces, len(directions), 2), -np.inf)
    for k in range(len(points)):
        if chosen[k]:
            lows, highs = low[piece[k]], high[piece[k]]
            for n in range(len(directions)):
                u = directions[n, 0] * points[k, 0] + directions[n, 1] * points[k, 1]
                v = directions[n, 0] * points[k, 1] - directions[n, 1] * points[k, 0]
                lows[n, 0], highs[n, 0] = min(lows[n, 0], u), max(highs[n, 0], u)
                lows[n, 1], highs[n, 1] = min(lows[n, 1], v), max(highs[n, 1], v)
    sides = np.empty((num_pieces, 2))
    for k in range(num_pieces):
        least = np.inf
        for n in range(len(directions)):
            first, second = high[k, n, 0] - low[k, n, 0], high[k, n, 1] - low[k, n, 1]
            if first * second < least:
                least = first * second
                sides[k, 0], sides[k, 1] = max(first, second), min(first, second)
    return sides
