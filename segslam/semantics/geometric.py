"""Labels from shape alone: ground, upright thin things, boxes, walls, and the rough rest.

They serve to find the same things again from elsewhere, so that they are repeatable matters more than what they mean.
"""

import numpy as np

from segslam.config import GeometricLabelsConfig
from segslam.semantics.ground import heights_above_ground, upright
from segslam.semantics.solids import NO_PIECE, pieces, tightest_rectangles, wall_voxels
from segslam.semantics.uprights import NUM_SLICES, SLICE_M, columns, thin_uprights
from segslam.types import Label, Labels, Points, Vector

COLUMN_M = 0.1
BOX_CELL_M = 0.25
WALL_CELL_M = 0.6
WALL_LAYER_M = 1.2
NUM_WALL_LAYERS = 8
MAX_UP_M = 30.0


def geometric_labels(points: Points, *, config: GeometricLabelsConfig) -> Labels:
    """A class for each point of a scan in the LiDAR frame, from shape alone; it does not depend on the points' order.

    ROAD for the ground, TRUNK for upright thin things, CAR for boxes of that size, BUILDING for walls, VEGETATION for
    what else stands above the ground. UNLABELLED where points are not finite or out of range. The sensor may lean.
    """
    labels = np.full(len(points), Label.UNLABELLED, np.uint8)
    usable = np.flatnonzero(np.all(np.abs(points) < config.max_range_m, axis=1))
    level = points[usable].astype(np.float64)
    level = level @ upright(level).T
    inside = np.all(np.abs(level) < config.max_range_m, axis=1)
    usable, level = usable[inside], level[inside]
    if len(usable):
        labels[usable] = _labels_of_level(level, config)
    return labels


def _labels_of_level(level: Points, config: GeometricLabelsConfig) -> Labels:
    heights = heights_above_ground(
        level, cell_m=config.ground_cell_m, max_range_m=config.max_range_m, max_slope=config.max_slope
    )
    labels = np.full(len(level), Label.VEGETATION, np.uint8)
    labels[heights < config.ground_height_m] = Label.ROAD
    standing = np.flatnonzero(labels != Label.ROAD)
    for label, rule in ((Label.TRUNK, _is_upright), (Label.CAR, _is_box), (Label.BUILDING, _is_wall)):
        chosen = rule(level[standing], heights[standing], config)
        labels[standing[chosen]] = label
        standing = standing[~chosen]
    return labels


def _is_upright(points: Points, heights: Vector, config: GeometricLabelsConfig) -> np.ndarray:
    cells, side = _cells(points, COLUMN_M, config.max_range_m)
    slices = np.floor(heights / SLICE_M).astype(np.int64)
    low, high = (round(height_m / SLICE_M) for height_m in (config.upright_low_m, config.upright_high_m))
    marked = thin_uprights(
        columns(cells, slices, side),
        round(config.upright_core_m / COLUMN_M),
        round(config.upright_clear_m / COLUMN_M),
        np.uint32(sum(1 << s for s in range(low, high))),
        round(config.upright_min_m / SLICE_M),
        config.upright_min_share,
    )
    bits = marked[cells[:, 0], cells[:, 1]] >> np.clip(slices, 0, NUM_SLICES - 1).astype(np.uint32)
    return (bits & 1).astype(bool) & (slices < NUM_SLICES)


def _is_box(points: Points, heights: Vector, config: GeometricLabelsConfig) -> np.ndarray:
    cells, side = _cells(points, BOX_CELL_M, config.max_range_m)
    low, high = config.box_top_m
    occupied = np.zeros((side, side), bool)
    body = heights < high
    occupied[tuple(cells[body].T)] = True
    piece = pieces(occupied)
    num_pieces = int(piece.max()) + 1
    if num_pieces == 0:
        return np.zeros(len(points), bool)
    length, width = (tightest_rectangles(piece, num_pieces) * BOX_CELL_M).T
    of_point = np.where(body, piece[tuple(cells.T)], NO_PIECE)
    top = np.zeros(num_pieces)
    np.maximum.at(top, of_point[body], heights[body])
    shortest, longest = config.box_length_m
    is_car = (
        (top > low) & (top < high - 0.1) & (length > shortest) & (length < longest) & (width < config.box_max_width_m)
    )
    return np.where(of_point == NO_PIECE, False, is_car[of_point])


def _is_wall(points: Points, heights: Vector, config: GeometricLabelsConfig) -> np.ndarray:
    cells, side = _cells(points, WALL_CELL_M, config.max_range_m)
    layers = np.clip(heights / WALL_LAYER_M, 0, NUM_WALL_LAYERS - 1).astype(np.int64)
    offsets_mm = np.round((points[:, :2] + config.max_range_m) * 1000).astype(np.int64)
    walls = wall_voxels(
        cells, layers, offsets_mm, (NUM_WALL_LAYERS, side, side), config.wall_thickness_m * 1000, 300.0, 8
    )
    return walls[layers, cells[:, 0], cells[:, 1]]


def _cells(points: Points, cell_m: float, max_range_m: float) -> tuple[np.ndarray, int]:
    """The grid cell of each point, and the grid's side; the border is wide enough for neighbourhoods."""
    border = 10
    half = int(np.ceil(max_range_m / cell_m)) + border
    return np.floor(points[:, :2] / cell_m).astype(np.int64) + half, 2 * half
