"""How far each keyframe saw the ground in each direction with nothing standing before it: space that is free.

Beams meet the ground in rings; between two rings nothing returns, yet the ray to the outer one passed over it.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from segslam.config import MapConfig
from segslam.map.ground_heights import ground_heights
from segslam.map.tiles import Tile, distance_m
from segslam.types import GROUND_LABELS, Label, Labels, Points, Vector

NUM_DIRECTIONS = 720
"""Chosen: half a degree, a cell of 0.2 m at 23 m."""
REACH_M = 40.0
"""Chosen: beyond it beams graze the ground and rings are too far apart to be sure of what lies between."""


class Sights:
    """The free range of each keyframe by direction in the world."""

    def __init__(self, config: MapConfig) -> None:
        self._low_m, self._high_m = config.obstacle_m
        self._places: list[Vector] = []
        self._free_m: list[Vector] = []

    def add(self, points: Points, labels: Labels, place: Vector) -> None:
        """Points of a keyframe in the world, and where it was taken."""
        self._places.append(place[:2])
        self._free_m.append(free_range_m(points - place, labels, low_m=self._low_m, high_m=self._high_m))

    def free(self, tile: Tile, places: Float[np.ndarray, "_ 2"]) -> Iterator[np.ndarray]:
        """For each keyframe near a tile, which of the places lie within its free range."""
        for place, free_m in zip(self._places, self._free_m, strict=True):
            if distance_m(tile, place) >= REACH_M:
                continue
            x, y = (places - place).T
            yield np.hypot(x, y) < free_m[_direction(x, y)]


def free_range_m(points: Points, labels: Labels, *, low_m: float, high_m: float) -> Vector:
    """(NUM_DIRECTIONS,) how far the ground is free in each direction, in metres. Points are relative to the sensor.

    Something stands there if it reaches from `low_m` to `high_m` above the ground; what may move does not count.
    """
    near = np.abs(points[:, :2]).max(axis=1, initial=0.0) < REACH_M
    near &= labels < Label.MOVING_CAR
    points, labels = points[near], labels[near]
    if not len(points):
        return np.zeros(NUM_DIRECTIONS)
    is_ground = np.isin(labels, np.array(GROUND_LABELS, np.uint8))
    within = points + np.array([REACH_M, REACH_M, 0.0])
    height_m = points[:, 2] - ground_heights(within, within[is_ground] if is_ground.any() else within, 2 * REACH_M)
    stands = (height_m >= low_m) & (height_m <= high_m) & ~is_ground
    range_m, direction = np.hypot(points[:, 0], points[:, 1]), _direction(points[:, 0], points[:, 1])
    farthest, nearest = np.zeros(NUM_DIRECTIONS), np.full(NUM_DIRECTIONS, np.inf)
    flat = is_ground | (height_m < low_m)
    np.maximum.at(farthest, direction[flat], range_m[flat])
    np.minimum.at(nearest, direction[stands], range_m[stands])
    return np.minimum(farthest, nearest)


def _direction(x: Vector, y: Vector) -> np.ndarray:
    turn = (np.arctan2(y, x) / (2 * np.pi)) % 1.0
    return (turn * NUM_DIRECTIONS).astype(np.int64) % NUM_DIRECTIONS
