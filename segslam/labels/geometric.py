"""Labels from geometry alone: ground, poles, small solid objects, cars, walls, and other objects.

Loop closing needs labels that are the same in every scan of a place; whether the class is correct matters less.
"""

from collections.abc import Iterator

import numpy as np

from segslam.core.points import within_range
from segslam.core.types import Label, Labels, Mask, Points, Vector
from segslam.labels.ground_surface import heights_above_ground, rotated, upright
from segslam.labels.shapes import BAND_M, Pieces, on_thin_uprights, on_walls, pieces

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
    for rule in (_poles, _solids, _walls):
        rest = np.flatnonzero(of_level == Label.VEGETATION)
        for label, found in rule(level[rest], heights[rest]):
            of_level[rest[found]] = label
    labels[usable] = of_level
    return labels


def _poles(points: Points, heights: Vector) -> Found:
    """Thin vertical objects."""
    thin = on_thin_uprights(points, heights)
    found = pieces(points[thin], heights[thin], np.full(thin.sum(), True))
    thin[thin] = _most_seen(found, np.full(len(found.top_m), True))[found.of_point]
    yield Label.POLE, thin


def _solids(points: Points, heights: Vector) -> Found:
    """Segments of the sizes of trunks and cars."""
    in_band = _within(heights, BAND_M)
    found = pieces(points, heights, in_band)
    is_trunk = (found.top_m >= TRUNK_MIN_M) & (found.length_m <= TRUNK_MAX_M)
    is_car = _within(found.top_m, CAR_TOP_M) & _within(found.length_m, CAR_LENGTH_M)
    is_car &= (found.width_m <= CAR_MAX_WIDTH_M) & ~is_trunk
    for label, suitable, eligible in ((Label.TRUNK, is_trunk, in_band), (Label.CAR, is_car, heights < BAND_M[1])):
        in_chosen = np.append(_most_seen(found, suitable), False)[found.of_point]  # NO_PIECE is the last one
        yield label, in_chosen & eligible


def _walls(points: Points, heights: Vector) -> Found:
    yield Label.BUILDING, on_walls(points, heights)


def _most_seen(found: Pieces, suitable: Mask) -> Mask:
    """The suitable segments with the most points: at most `max_things`, or more if the last ones have equal counts."""
    counts = np.sort(found.num_points[suitable])
    least = max(MIN_POINTS, counts[-MAX_THINGS]) if len(counts) > MAX_THINGS else MIN_POINTS
    return suitable & (found.num_points >= least)


def _within(values: Vector, bounds: tuple[float, float]) -> Mask:
    return (values >= bounds[0]) & (values <= bounds[1])
