"""Free space: a ray that returned from 30 m passed through empty space up to there.

The returns of a scan form a spherical image with rows as fine as the sensor's beams. A point of another scan violates
free space if it lies in front of all returns around its direction, by a margin that depends on the place: 1 m in a
street, 0.4 m in a corridor.
"""

import math

import numpy as np
from jaxtyping import Int8
from scipy.ndimage import minimum_filter

from segslam.core import geometry
from segslam.core.points import within_range
from segslam.core.types import Indices, Points, Transform, Vector

FREE_SPACE_MARGIN_M = 1.0
"""Chosen for KITTI's streets: distance before a return at which a point violates free space; less in narrow places
(m)."""
FREE_SPACE_MARGIN_RATIO = 0.02
"""Chosen: increase of that distance per metre of range."""

NUM_COLUMNS = 360
"""A cell is one degree wide."""
ROWS_RAD = tuple(math.radians(0.5 * 2.0 ** (step / 2)) for step in range(7))
"""Cell heights that are tried: 0.5 to 4 degrees."""
MIN_DETAIL = 1.6
"""Chosen: smallest ratio of filled cells when the cell height is halved: 2 if all cells are filled, 1 if the beams
are so far apart that half of the rows stay empty."""
SHARE_OF_PATH = 0.125
"""Chosen: the margin as a share of the free path, the median range over the directions with a return. 1 m where the
sensor sees 8 m far, as in KITTI's streets (7 to 9)."""
MIN_MARGIN_M = 0.3
"""Chosen: three times the range noise of a poor sensor."""

Fates = Int8[np.ndarray, "_"]
"""For each point one of the following."""
IN_FRONT, AT_RETURN, BEHIND, NO_RETURN = range(4)
"""A point in front of all returns around its direction violates free space; behind them it is hidden."""


class FreeSpace:
    """Spherical image of a scan: for each direction with a return, the nearest return there or in the 8 cells around.

    Rows have equal height, from the lowest elevation of the scan to the highest. Cells without a return are infinite:
    they are unknown, not free, because grazing rays on the ground are often lost.
    """

    def __init__(self, points: Points) -> None:
        """`points` (n, 3) are in the sensor's frame."""
        with np.errstate(over="ignore"):  # infinite: no return
            rays = np.ascontiguousarray(points, np.float32)
        range_m, elevation_rad, column = _spherical(rays.compress(within_range(rays, 0.0, np.inf), axis=0))
        self.lowest_rad = float(elevation_rad.min()) if len(range_m) else 0.0
        """Lower edge of the first row."""
        self.row_rad = _row_height(elevation_rad - self.lowest_rad, column)
        """Height of a row."""
        row = ((elevation_rad - self.lowest_rad) / self.row_rad).astype(np.int64)
        nearest = np.full((row.max(initial=0) + 1, NUM_COLUMNS), np.inf, np.float32)
        np.minimum.at(nearest, (row, column), range_m)
        seen = np.isfinite(nearest)
        self.nearest_m = np.where(seen, minimum_filter(nearest, 3, mode=("nearest", "wrap")), np.float32(np.inf))
        """(rows, columns), float32, m."""
        path_m = float(np.median(nearest[seen])) if seen.any() else 0.0
        self.margin_m = min(max(SHARE_OF_PATH * path_m, MIN_MARGIN_M), FREE_SPACE_MARGIN_M)
        """Distance before a return at which a point violates free space, besides the growth with its range."""


def _spherical(points: Points) -> tuple[Vector, Vector, Indices]:
    """Range (m), elevation (rad) and column of the image of float32 points."""
    range_m, elevation_rad, azimuth_rad = geometry.spherical(points)
    column = ((azimuth_rad.astype(np.float64) + math.pi) / math.tau * NUM_COLUMNS).astype(np.int64) % NUM_COLUMNS
    return range_m, elevation_rad.astype(np.float64), column


def _row_height(elevation_rad: Vector, column: Indices) -> float:
    """The smallest row height that leaves few rows empty between two beams."""
    counts = []
    for row_rad in (*ROWS_RAD, 2 * ROWS_RAD[-2], 2 * ROWS_RAD[-1]):
        rows = (elevation_rad / row_rad).astype(np.int64)
        filled = np.zeros((rows.max(initial=0) + 1, NUM_COLUMNS), bool)
        filled[rows, column] = True
        counts.append(int(filled.sum()))
    detail = [fine / max(coarse, 1) for fine, coarse in zip(counts, counts[2:], strict=False)]
    return next((row_rad for row_rad, found in zip(ROWS_RAD, detail, strict=True) if found >= MIN_DETAIL), ROWS_RAD[-1])


def violation(points: Points, seen: FreeSpace, T_view_points: Transform) -> float:
    """Share, 0 to 1, of the points that lie in front of all returns around their direction.

    Only directions with a return count; 0 where there is none.
    """
    found = fates(geometry.apply(T_view_points, points), seen)
    known = found[found != NO_RETURN]
    return float(np.mean(known == IN_FRONT)) if len(known) else 0.0


def fates(points: Points, seen: FreeSpace) -> Fates:
    """Where points (n, 3) in the frame of the scan that sees are, compared with the returns in their direction."""
    range_m, elevation_rad, column = _spherical(points.astype(np.float32))
    row = np.floor((elevation_rad - seen.lowest_rad) / seen.row_rad).astype(np.int64)
    above = np.clip(row, 0, len(seen.nearest_m) - 1) != row  # or below
    return_m = np.where(above, np.inf, seen.nearest_m[np.where(above, 0, row), column])
    room_m = seen.margin_m + FREE_SPACE_MARGIN_RATIO * range_m
    conditions = [np.isinf(return_m), range_m > return_m + room_m, range_m + room_m < return_m]
    return np.select(conditions, [NO_RETURN, BEHIND, IN_FRONT], AT_RETURN).astype(np.int8)
