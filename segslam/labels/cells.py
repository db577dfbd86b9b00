"""Square grid cells in the x-y plane."""

import numpy as np

from segslam.core.types import IndexPairs, Points, Vector


def grid_cells(points: Points, cell_m: float, *, border: int) -> tuple[IndexPairs, Vector, tuple[int, int]]:
    """The cell (n, 2) of each point, the corner of the grid (m), and the number of rows and columns.

    The grid contains all points and a margin of `border` empty cells.
    """
    whole = [np.floor(points[:, axis] / cell_m) for axis in (0, 1)]
    first = np.array([column.min() if len(points) else 0.0 for column in whole]) - border
    cells = np.column_stack([column - start for column, start in zip(whole, first, strict=True)]).astype(np.int64)
    rows, columns = (int(cells[:, axis].max(initial=0)) + border + 1 for axis in (0, 1))
    return cells, first * cell_m, (rows, columns)
