"""Shapes above the ground: thin objects in a grid of columns, walls, and segments of connected cells, with their sizes.

A column is a square cell of the x-y plane. A bit mask holds its occupied height slices, so that neighbourhoods are
combined by bitwise operations. A pole is an object with free space all around, as in occupancy-grid pole extractors
(Schaefer, Büscher, Vertens, Luft, Burgard, "Long-term urban vehicle localization using pole landmarks extracted from
3-D lidar scans", ECMR 2019). A wall is a voxel whose points lie along one line and reach high enough.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label, maximum_filter

from segslam.core.types import IndexPairs, Indices, Mask, Points, Vector

COLUMN_M = 0.1
"""Chosen: a post is some cells wide, and points on it are rarely farther apart at ranges below 40 m."""
BAND_M = (0.4, 2.6)
"""Chosen: lowest and highest height in which poles and small solids are searched (m)."""
NUM_SLICES = 16
SLICE_M = (BAND_M[1] - BAND_M[0]) / NUM_SLICES
CORE, RING = 4, 8
"""Chosen, in columns: largest radius of a pole, and radius around it without other points."""
MIN_SLICES = round(1.0 / SLICE_M)
"""Chosen: smallest height of a pole within the band, 1 m."""
MIN_SHARE = 0.7
"""Chosen: smallest share of the heights of a pole without other points nearby."""
WALL_CELL_M = 0.6
"""Chosen, like the next constants, by the IoU of buildings on the real KITTI scans 0-2 (`tools/benchmarks/labels`)."""
WALL_THICKNESS_M = 0.16
"""Standard deviation of a wall's points across it."""
WALL_MIN_TOP_M = 1.8
"""Smallest height of the top of a wall; hedges are lower."""
LAYER_M = 2.0
NUM_LAYERS = 5
MIN_LENGTH_M = 0.3
"""Smallest standard deviation along the line."""
MIN_POINTS = 8
CELL_M = 0.3
"""Chosen: objects nearer to each other than this form one segment."""
NO_PIECE = -1
RECTANGLE_STEP_DEG = 5.0
"""Chosen: angle steps for which the short side of a car is overestimated by at most 20 cm."""
_ANGLES = np.radians(np.arange(0.0, 90.0, RECTANGLE_STEP_DEG))
COSINES, SINES = np.cos(_ANGLES), np.sin(_ANGLES)


def on_thin_uprights(points: Points, heights: Vector) -> Mask:
    """(n,) bool: whether each point belongs to a thin, tall, free-standing object, for points in a level frame.

    For each occupied column: combine the slices occupied within `CORE` cells, and remove those occupied between `CORE`
    and `RING` cells away. The remaining slices must span `MIN_SLICES` and be a share `MIN_SHARE` of the slices before
    removal. Points outside the band of heights are ignored.
    """
    cells, _, shape = grid_cells(points, COLUMN_M, border=RING)
    slices = np.floor((heights - BAND_M[0]) / SLICE_M).astype(np.int64)
    chosen = (slices >= 0) & (slices < NUM_SLICES)
    column, bits = (cells[:, 0] * shape[1] + cells[:, 1])[chosen], (1 << slices[chosen]).astype(np.uint16)
    masks, thin = np.zeros((2, shape[0] * shape[1]), np.uint16)
    np.bitwise_or.at(masks, column, bits)
    a, b = np.mgrid[-RING : RING + 1, -RING : RING + 1].reshape(2, -1)
    steps, squared = a * shape[1] + b, a * a + b * b
    inner, outer = steps[squared <= CORE**2], steps[(squared > CORE**2) & (squared <= RING**2)]
    places = np.flatnonzero(masks)
    held = np.bitwise_or.reduce([masks[places + step] for step in inner])
    tall = _span(held) >= MIN_SLICES
    places, held = places[tall], held[tall]
    clear = held & ~np.bitwise_or.reduce([masks[places + step] for step in outer])
    clear[np.bitwise_count(clear) < MIN_SHARE * np.bitwise_count(held)] = 0
    clear[_span(clear) < MIN_SLICES] = 0
    for step in inner:
        thin[places + step] |= clear
    chosen[chosen] = thin[column] & bits != 0
    return chosen


def _span(masks: np.ndarray) -> np.ndarray:
    """Number of bits from the lowest to the highest set bit, both included."""
    lowest, highest = (np.frexp(bits.astype(float))[1] for bits in (masks & -masks.astype(int), masks))
    return np.where(masks > 0, highest - lowest + 1, 0)


def on_walls(points: Points, heights: Vector) -> Mask:
    """(n,) bool: whether each point is on a vertical surface, for points in a level frame.

    Each voxel is tested with its 8 neighbours: the standard deviation of the points perpendicular to their line must be
    below `WALL_THICKNESS_M`, and one of the points must be higher than `WALL_MIN_TOP_M` above the ground.
    """
    cells, corner, shape = grid_cells(points, WALL_CELL_M, border=1)
    layers = np.clip(heights / LAYER_M, 0, NUM_LAYERS - 1).astype(np.int64)
    column = cells[:, 0] * shape[1] + cells[:, 1]
    voxel = layers * (shape[0] * shape[1]) + column
    occupied = np.zeros(NUM_LAYERS * shape[0] * shape[1], bool)
    occupied[voxel] = True
    rows, places = np.cumsum(occupied) - 1, np.flatnonzero(occupied)  # row of each occupied voxel, and the reverse
    x, y = np.round((points[:, :2] - corner) * 1000).T  # whole mm: the sums do not depend on the order of the points
    values = np.ones(len(points)), x, y, x * x, x * y, y * y
    own = np.array([np.bincount(rows[voxel], value, len(places)) for value in values])
    near = [places + i * shape[1] + j for i in (-1, 0, 1) for j in (-1, 0, 1)]  # the border of the grid is empty
    n, *sums = np.sum([own[:, rows[voxels]] * occupied[voxels] for voxels in near], axis=0)
    x, y, xx, xy, yy = (one / n for one in sums)
    a, b, c = xx - x**2, xy - x * y, yy - y**2
    middle, spread = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
    top = np.full(shape, -np.inf)
    np.maximum.at(top.ravel(), column, heights)
    walls = (n >= MIN_POINTS) & (maximum_filter(top, 3).ravel()[places % top.size] >= WALL_MIN_TOP_M)
    walls &= (middle - spread < (WALL_THICKNESS_M * 1000) ** 2) & (middle + spread > (MIN_LENGTH_M * 1000) ** 2)
    return walls[rows[voxel]]


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
    rows = np.flatnonzero(chosen)
    rows = rows[np.argsort(of_point[rows], kind="stable")]
    starts = np.searchsorted(of_point[rows], np.arange(num_pieces))
    num_points = np.diff(starts, append=len(rows))
    x, y = points[rows, 0], points[rows, 1]
    turned = ((c * x + s * y, c * y - s * x) for c, s in zip(COSINES, SINES, strict=True))
    sides_m = np.array([[np.maximum.reduceat(u, starts) - np.minimum.reduceat(u, starts) for u in uv] for uv in turned])
    tightest = sides_m.prod(axis=1).argmin(axis=0)
    width_m, length_m = np.sort(sides_m[tightest, :, np.arange(num_pieces)], axis=1).T
    return Pieces(of_point, num_points, np.maximum.reduceat(heights[rows], starts), length_m, width_m)


def grid_cells(points: Points, cell_m: float, *, border: int) -> tuple[IndexPairs, Vector, tuple[int, int]]:
    """The cell (n, 2) of each point, the corner of the grid (m), and the number of rows and columns.

    The grid contains all points and a margin of `border` empty cells.
    """
    whole = [np.floor(points[:, axis] / cell_m) for axis in (0, 1)]
    first = np.array([column.min() if len(points) else 0.0 for column in whole]) - border
    cells = np.column_stack([column - start for column, start in zip(whole, first, strict=True)]).astype(np.int64)
    rows, columns = (int(cells[:, axis].max(initial=0)) + border + 1 for axis in (0, 1))
    return cells, first * cell_m, (rows, columns)
