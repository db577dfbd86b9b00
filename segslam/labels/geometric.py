"""Labels from geometry alone: ground, poles, small solid objects, cars, walls, and other objects.

Loop closing needs labels that are the same in every scan of a place; whether the class is correct matters less.

A column is a square cell of the x-y plane. A bit mask holds its occupied height slices, so that neighbourhoods are
combined by bitwise operations. A pole is an object with free space all around, as in occupancy-grid pole extractors
(Schaefer, Büscher, Vertens, Luft, Burgard, "Long-term urban vehicle localization using pole landmarks extracted from
3-D lidar scans", ECMR 2019). A wall is a voxel whose points lie along one line and reach high enough.
"""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import label, maximum_filter

from segslam.core.points import within_range
from segslam.core.types import IndexPairs, Label, Labels, Mask, Points, Vector
from segslam.labels.ground_surface import heights_above_ground, rotated, upright

Found = Iterator[tuple[Label, Mask]]
"""The points of a cloud that have a class."""

MAX_RANGE_M = 70.0
"""Chosen: points farther away remain unlabelled (m)."""
GROUND_HEIGHT_M = 0.15
"""Chosen: points lower than this are ground (m)."""
MIN_POINTS = 4
"""Chosen: smallest number of points of a pole, small solid or car within the band."""
MAX_THINGS = 30
"""Chosen: largest number of objects per class; those with most points are kept."""
TRUNK_MAX_M = 1.6
"""Chosen: largest length of a small solid: young trees, bushes, signs (m)."""
TRUNK_MIN_M = 1.6
"""Chosen: smallest height of the top of a small solid (m)."""
CAR_TOP_M = (1.0, 2.1)
"""Chosen: lowest and highest top of a car (m)."""
CAR_LENGTH_M = (1.0, 6.0)
"""Chosen: shortest and longest visible side of a car (m)."""
CAR_MAX_WIDTH_M = 2.4
"""Chosen: largest width of a car (m)."""

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
WALL_MIN_POINTS = 8
CELL_M = 0.3
"""Chosen: objects nearer to each other than this form one segment."""
NO_PIECE = -1
RECTANGLE_STEP_DEG = 5.0
"""Chosen: angle steps for which the short side of a car is overestimated by at most 20 cm."""
_ANGLES = np.radians(np.arange(0.0, 90.0, RECTANGLE_STEP_DEG))
COSINES, SINES = np.cos(_ANGLES), np.sin(_ANGLES)


def geometric_labels(points: Points) -> Labels:
    """A class for each point (n, 3) of a scan in the LiDAR frame, independent of the order of the points.

    ROAD: ground. POLE: thin vertical objects. TRUNK: small solid objects (young trees, bushes, signs). Poles and trunks
    are limited to a band of heights, so that their centres are repeatable. CAR: boxes of the size of a car.
    BUILDING: walls. VEGETATION: all other objects above the ground. UNLABELLED: points that are not finite or out of
    range. The sensor may be tilted by up to 40 degrees.
    """
    labels = np.full(len(points), Label.UNLABELLED, np.uint8)
    usable = within_range(points, 0.0, MAX_RANGE_M)
    if not usable.any():
        return labels
    near = points[usable].astype(np.float64)
    level = rotated(near, upright(near))
    heights = heights_above_ground(level, max_range_m=MAX_RANGE_M)
    of_level = np.where(heights < GROUND_HEIGHT_M, np.uint8(Label.ROAD), np.uint8(Label.VEGETATION))
    for rule in (_poles, _solids):
        rest = np.flatnonzero(of_level == Label.VEGETATION)
        for kind, found in rule(level[rest], heights[rest]):
            of_level[rest[found]] = kind
    rest = np.flatnonzero(of_level == Label.VEGETATION)
    of_level[rest[on_walls(level[rest], heights[rest])]] = Label.BUILDING
    labels[usable] = of_level
    return labels


def _poles(points: Points, heights: Vector) -> Found:
    thin = on_thin_uprights(points, heights)
    found = Pieces(points[thin], heights[thin], np.full(thin.sum(), True))
    thin[thin] = _most_seen(found, np.full(len(found.top_m), True))[found.of_point]
    yield Label.POLE, thin


def _solids(points: Points, heights: Vector) -> Found:
    """Segments of the sizes of trunks and cars."""
    in_band = _within(heights, BAND_M)
    found = Pieces(points, heights, in_band)
    is_trunk = (found.top_m >= TRUNK_MIN_M) & (found.length_m <= TRUNK_MAX_M)
    is_car = _within(found.top_m, CAR_TOP_M) & _within(found.length_m, CAR_LENGTH_M)
    is_car &= (found.width_m <= CAR_MAX_WIDTH_M) & ~is_trunk
    for kind, suitable, eligible in ((Label.TRUNK, is_trunk, in_band), (Label.CAR, is_car, heights < BAND_M[1])):
        in_chosen = np.append(_most_seen(found, suitable), False)[found.of_point]  # NO_PIECE is the last one
        yield kind, in_chosen & eligible


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
    walls = (n >= WALL_MIN_POINTS) & (maximum_filter(top, 3).ravel()[places % top.size] >= WALL_MIN_TOP_M)
    walls &= (middle - spread < (WALL_THICKNESS_M * 1000) ** 2) & (middle + spread > (MIN_LENGTH_M * 1000) ** 2)
    return walls[rows[voxel]]


class Pieces:
    """Segments of connected cells of the chosen points of a level cloud. All but `of_point` have a row per segment."""

    def __init__(self, points: Points, heights: Vector, chosen: Mask) -> None:
        cells, _, shape = grid_cells(points, CELL_M, border=1)
        occupied = np.zeros(shape, bool)
        occupied[cells[chosen, 0], cells[chosen, 1]] = True
        grid, num_pieces = label(occupied, structure=np.ones((3, 3), bool))
        self.of_point = grid[cells[:, 0], cells[:, 1]].astype(np.int64) + NO_PIECE  # labels start at 1, 0: background
        """(n,) segment of each point, also of points that were not chosen; NO_PIECE if it has none."""
        rows = np.flatnonzero(chosen)
        rows = rows[np.argsort(self.of_point[rows], kind="stable")]
        starts = np.searchsorted(self.of_point[rows], np.arange(num_pieces))
        self.num_points = np.diff(starts, append=len(rows))
        x, y = points[rows, 0], points[rows, 1]
        turned = ((c * x + s * y, c * y - s * x) for c, s in zip(COSINES, SINES, strict=True))
        sides_m = np.array(
            [[np.maximum.reduceat(u, starts) - np.minimum.reduceat(u, starts) for u in uv] for uv in turned]
        )
        tightest = sides_m.prod(axis=1).argmin(axis=0)
        self.width_m, self.length_m = np.sort(sides_m[tightest, :, np.arange(num_pieces)], axis=1).T
        """Sides of the smallest-area bounding rectangle in the x-y plane, of the chosen points."""
        self.top_m = np.maximum.reduceat(heights[rows], starts)
        """Height of the highest chosen point above the ground."""


def grid_cells(points: Points, cell_m: float, *, border: int) -> tuple[IndexPairs, Vector, tuple[int, int]]:
    """The cell (n, 2) of each point, the corner of the grid (m), and the number of rows and columns.

    The grid contains all points and a margin of `border` empty cells.
    """
    whole = [np.floor(points[:, axis] / cell_m) for axis in (0, 1)]
    first = np.array([column.min() if len(points) else 0.0 for column in whole]) - border
    cells = np.column_stack([column - start for column, start in zip(whole, first, strict=True)]).astype(np.int64)
    rows, columns = (int(cells[:, axis].max(initial=0)) + border + 1 for axis in (0, 1))
    return cells, first * cell_m, (rows, columns)


def _most_seen(found: Pieces, suitable: Mask) -> Mask:
    """The suitable segments with the most points: at most `MAX_THINGS`, or more if the last ones have equal counts."""
    counts = np.sort(found.num_points[suitable])
    least = max(MIN_POINTS, counts[-MAX_THINGS]) if len(counts) > MAX_THINGS else MIN_POINTS
    return suitable & (found.num_points >= least)


def _within(values: Vector, bounds: tuple[float, float]) -> Mask:
    return (values >= bounds[0]) & (values <= bounds[1])
