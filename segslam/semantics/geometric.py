"""Labels from shape alone: ground, poles, small solids, cars, walls, and the rough rest.

They serve to find the same things again from elsewhere, so that they are repeatable matters more than what they mean.
"""

import numpy as np

from segslam.config import GeometricLabelsConfig
from segslam.points import within_range
from segslam.semantics.ground import heights_above_ground, turned, upright
from segslam.semantics.solids import NO_PIECE, pieces, tightest_rectangles
from segslam.semantics.uprights import NUM_SLICES, on_thin_uprights
from segslam.semantics.walls import on_walls
from segslam.types import Label, Labels, Mask, Points, Vector

COLUMN_M = 0.1
"""Chosen: posts are some cells wide, and points on one are rarely farther apart within 40 m."""
PIECE_CELL_M = 0.25
"""Chosen: solids closer than this are one."""
BORDER_CELLS = 10


def geometric_labels(points: Points, *, config: GeometricLabelsConfig) -> Labels:
    """A class for each point of a scan in the LiDAR frame, from shape alone. It does not depend on the points' order.

    ROAD for the ground, POLE for thin upright things, TRUNK for small solids (young trees, bushes, signs), both only
    within a band of heights so that their centres keep still; CAR for boxes of that size, BUILDING for walls,
    VEGETATION for what else stands above the ground. UNLABELLED where points are not finite or out of range. The
    sensor may lean.
    """
    labels = np.full(len(points), Label.UNLABELLED, np.uint8)
    usable = within_range(points, 0.0, config.max_range_m)
    if usable.any():
        near = points[usable].astype(np.float64)
        labels[usable] = _labels_of_level(turned(near, upright(near)), config)
    return labels


def _labels_of_level(level: Points, config: GeometricLabelsConfig) -> Labels:
    heights = heights_above_ground(
        level, cell_m=config.ground_cell_m, max_range_m=config.max_range_m, max_slope=config.max_slope
    )
    labels = np.where(heights < config.ground_height_m, np.uint8(Label.ROAD), np.uint8(Label.VEGETATION))
    for rule in (_poles, _solids, _walls):
        rest = np.flatnonzero(labels == Label.VEGETATION)
        labels[rest] = rule(level[rest], heights[rest], config)
    return labels


def _poles(points: Points, heights: Vector, config: GeometricLabelsConfig) -> Labels:
    """POLE for the points of thin upright things, VEGETATION for the rest."""
    low, high = config.band_m
    slice_m = (high - low) / NUM_SLICES
    cells, side = _cells(points, COLUMN_M, config.max_range_m)
    thin = on_thin_uprights(
        cells,
        np.floor((heights - low) / slice_m).astype(np.int64),
        side,
        round(config.pole_core_m / COLUMN_M),
        round(config.pole_clear_m / COLUMN_M),
        round(config.pole_min_m / slice_m),
        config.pole_min_share,
    )
    return _chosen(thin, Label.POLE)


def _solids(points: Points, heights: Vector, config: GeometricLabelsConfig) -> Labels:
    """TRUNK and CAR for the points of pieces of that size, VEGETATION for the rest."""
    low, high = config.band_m
    cells, side = _cells(points, PIECE_CELL_M, config.max_range_m)
    in_band = _within(heights, config.band_m)
    occupied = np.zeros((side, side), bool)
    occupied[cells[in_band, 0], cells[in_band, 1]] = True
    grid = pieces(occupied)
    body = np.flatnonzero((heights < high) & (grid[cells[:, 0], cells[:, 1]] != NO_PIECE))
    piece = grid[cells[body, 0], cells[body, 1]]
    num_pieces = int(grid.max()) + 1
    top = np.zeros(num_pieces)
    np.maximum.at(top, piece, heights[body])
    length, width = tightest_rectangles(grid, num_pieces).T * PIECE_CELL_M
    is_trunk = (top >= config.trunk_min_m) & (length <= config.trunk_max_m)
    is_car = _within(top, config.car_top_m) & _within(length, config.car_length_m) & (width < config.car_max_width_m)
    labels = np.full(len(points), Label.VEGETATION, np.uint8)
    labels[body[is_car[piece]]] = Label.CAR
    labels[body[is_trunk[piece] & (heights[body] >= low)]] = Label.TRUNK
    return labels


def _walls(points: Points, heights: Vector, config: GeometricLabelsConfig) -> Labels:
    """BUILDING for points on vertical faces, VEGETATION for the rest."""
    walls = on_walls(points, heights, thickness_m=config.wall_thickness_m, min_top_m=config.wall_min_top_m)
    return _chosen(walls, Label.BUILDING)


def _chosen(mask: Mask, label: Label) -> Labels:
    return np.where(mask, np.uint8(label), np.uint8(Label.VEGETATION))


def _within(values: Vector, bounds: tuple[float, float]) -> Mask:
    return (values >= bounds[0]) & (values <= bounds[1])


def _cells(points: Points, cell_m: float, max_range_m: float) -> tuple[np.ndarray, int]:
    """The grid cell of each point, and the grid's side; its border is wide enough for neighbourhoods."""
    half = int(np.ceil(max_range_m / cell_m)) + BORDER_CELLS
    return np.floor(points[:, :2] / cell_m).astype(np.int64) + half, 2 * half
