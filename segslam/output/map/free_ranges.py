"""Free space: heights above the ground, and how far each keyframe sees the ground without an obstacle, by direction.

Beams hit the ground in rings. There are no points between two rings, but the ray to the outer ring passed over the gap.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from segslam.core.types import GROUND_LABELS, Label, Labels, Mask, Points, Vector
from segslam.output.map.tiles import Tile, distance_m

OBSTACLE_M = (0.3, 2.0)
"""Chosen: heights above the ground where a voxel is an obstacle (m)."""
GROUND_CELL_M = 2.0
NUM_DIRECTIONS = 720
"""Chosen: steps of half a degree; one step is a cell of 0.2 m at 23 m."""
REACH_M = 40.0
"""Chosen: at larger ranges, grazing beams leave gaps between rings that may hide obstacles."""


class FreeRanges:
    """The free range of each keyframe, by direction in the world."""

    def __init__(self) -> None:
        self._places: list[Vector] = []
        self._free_m: list[Vector] = []

    def add(self, points: Points, labels: Labels, place: Vector) -> None:
        """Add a keyframe: its points (n, 3) in the world, and its position."""
        self._places.append(place[:2])
        self._free_m.append(free_range_m(points - place, labels))

    def is_free(self, tile: Tile, places: Float[np.ndarray, "_ 2"]) -> Mask:
        """Whether each of the places (n, 2) of a tile is within the free range of a keyframe."""
        free = np.zeros(len(places), bool)
        for place, free_m in zip(self._places, self._free_m, strict=True):
            if distance_m(tile, place) < REACH_M:
                x, y = (places - place).T
                free |= np.hypot(x, y) < free_m[_direction(x, y)]
        return free


def free_range_m(points: Points, labels: Labels) -> Vector:
    """(NUM_DIRECTIONS,) free range (m) in each direction. Points (n, 3) are relative to the sensor.

    Points of moving classes do not count.
    """
    near = np.abs(points[:, :2]).max(axis=1, initial=0.0) < REACH_M
    near &= labels < Label.MOVING_CAR
    points, labels = points[near], labels[near]
    if not len(points):
        return np.zeros(NUM_DIRECTIONS)
    stands, flat = obstacles_and_ground(points + np.array([REACH_M, REACH_M, 0.0]), labels, 2 * REACH_M)
    range_m, direction = np.hypot(points[:, 0], points[:, 1]), _direction(points[:, 0], points[:, 1])
    farthest, nearest = np.zeros(NUM_DIRECTIONS), np.full(NUM_DIRECTIONS, np.inf)
    np.maximum.at(farthest, direction[flat], range_m[flat])
    np.minimum.at(nearest, direction[stands], range_m[stands])
    return np.minimum(farthest, nearest)


def _direction(x: Vector, y: Vector) -> np.ndarray:
    turn = (np.arctan2(y, x) / (2 * np.pi)) % 1.0
    return (turn * NUM_DIRECTIONS).astype(np.int64) % NUM_DIRECTIONS


def obstacles_and_ground(points: Points, labels: Labels, side_m: float) -> tuple[Mask, Mask]:
    """Whether each point is an obstacle, and whether it shows that the ground is flat. Points as in `lowest_ground`."""
    is_ground = np.isin(labels, np.array(GROUND_LABELS, np.uint8))
    height_m = points[:, 2] - lowest_ground(points, points[is_ground] if is_ground.any() else points, side_m)
    low_m, high_m = OBSTACLE_M
    return (height_m >= low_m) & (height_m <= high_m) & ~is_ground, is_ground | (height_m < low_m)


def lowest_ground(points: Points, ground: Points, side_m: float) -> Vector:
    """Height (n,) of the ground (m) below each point: the lowest point of `ground` in its cell, or in the nearest cell.

    All points lie within a square of `side_m`, with x and y measured from its corner.
    """
    size = round(side_m / GROUND_CELL_M)
    lowest = np.full((size, size), np.inf)
    np.minimum.at(lowest, _cells(ground, size), ground[:, 2])
    nearest = distance_transform_edt(np.isinf(lowest), return_distances=False, return_indices=True)
    return lowest[tuple(nearest)][_cells(points, size)]


def _cells(points: Points, size: int) -> tuple[np.ndarray, np.ndarray]:
    column, row = np.clip((points[:, :2] / GROUND_CELL_M).astype(np.int64), 0, size - 1).T
    return column, row
