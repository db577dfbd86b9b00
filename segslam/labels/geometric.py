"""Labels from geometry alone: ground, poles, small solid objects, cars, walls, and other objects.

Loop closing needs labels that are the same in every scan of a place; whether the class is correct matters less.
"""

import numpy as np

from segslam.core.config import GeometricLabelsConfig
from segslam.core.points import within_range
from segslam.core.types import Label, Labels, Mask, Points, Vector
from segslam.labels.cells import grid_cells
from segslam.labels.ground_surface import heights_above_ground, rotated, upright
from segslam.labels.solids import Pieces, pieces
from segslam.labels.uprights import NUM_SLICES, on_thin_uprights
from segslam.labels.walls import on_walls

COLUMN_M = 0.1
"""Chosen: a post is some cells wide, and points on it are rarely farther apart at ranges below 40 m."""


def geometric_labels(points: Points, *, config: GeometricLabelsConfig) -> Labels:
    """A class for each point (n, 3) of a scan in the LiDAR frame, independent of the order of the points.

    ROAD: ground. POLE: thin vertical objects. TRUNK: small solid objects (young trees, bushes, signs). Poles and trunks
    are limited to a band of heights, so that their centres are repeatable. CAR: boxes of the size of a car.
    BUILDING: walls. VEGETATION: all other objects above the ground. UNLABELLED: points that are not finite or out of
    range. The sensor may be tilted by up to 40 degrees.
    """
    labels = np.full(len(points), Label.UNLABELLED, np.uint8)
    usable = within_range(points, 0.0, config.max_range_m)
    if usable.any():
        near = points[usable].astype(np.float64)
        labels[usable] = _labels_of_level(rotated(near, upright(near)), config)
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
    """POLE for the points of thin vertical objects, VEGETATION for the others."""
    low, high = config.band_m
    slice_m = (high - low) / NUM_SLICES
    ring = round(config.pole_clear_m / COLUMN_M)
    cells, _, shape = grid_cells(points, COLUMN_M, border=ring)
    thin = on_thin_uprights(
        cells,
        np.floor((heights - low) / slice_m).astype(np.int64),
        shape,
        round(config.pole_core_m / COLUMN_M),
        ring,
        round(config.pole_min_m / slice_m),
        config.pole_min_share,
    )
    rows = np.flatnonzero(thin)
    found = pieces(points[rows], heights[rows], np.full(len(rows), True))
    kept = _most_seen(found, np.full(len(found.top_m), True), config)
    labels = np.full(len(points), Label.VEGETATION, np.uint8)
    labels[rows[kept[found.of_point]]] = Label.POLE
    return labels


def _solids(points: Points, heights: Vector, config: GeometricLabelsConfig) -> Labels:
    """TRUNK and CAR for the points of segments of these sizes, VEGETATION for the others."""
    in_band = _within(heights, config.band_m)
    found = pieces(points, heights, in_band)
    is_trunk = (found.top_m >= config.trunk_min_m) & (found.length_m <= config.trunk_max_m)
    is_car = _within(found.top_m, config.car_top_m) & _within(found.length_m, config.car_length_m)
    is_car &= (found.width_m <= config.car_max_width_m) & ~is_trunk
    trunks = _labelled(found, _most_seen(found, is_trunk, config), in_band, Label.TRUNK)
    cars = _labelled(found, _most_seen(found, is_car, config), heights < config.band_m[1], Label.CAR)
    return np.where(trunks == Label.TRUNK, trunks, cars)


def _walls(points: Points, heights: Vector, config: GeometricLabelsConfig) -> Labels:
    """BUILDING for points on vertical surfaces, VEGETATION for the others."""
    walls = on_walls(points, heights, thickness_m=config.wall_thickness_m, min_top_m=config.wall_min_top_m)
    return np.where(walls, np.uint8(Label.BUILDING), np.uint8(Label.VEGETATION))


def _most_seen(found: Pieces, suitable: Mask, config: GeometricLabelsConfig) -> Mask:
    """The suitable segments with the most points: at most `max_things`, or more if the last ones have equal counts."""
    counts = np.sort(found.num_points[suitable])
    least = max(config.min_points, counts[-config.max_things]) if len(counts) > config.max_things else config.min_points
    return suitable & (found.num_points >= least)


def _labelled(found: Pieces, chosen: Mask, eligible: Mask, label: Label) -> Labels:
    """`label` for the eligible points of the chosen segments, VEGETATION for the others."""
    in_chosen = np.append(chosen, False)[found.of_point]  # points without a segment have the number -1
    return np.where(in_chosen & eligible, np.uint8(label), np.uint8(Label.VEGETATION))


def _within(values: Vector, bounds: tuple[float, float]) -> Mask:
    return (values >= bounds[0]) & (values <= bounds[1])
