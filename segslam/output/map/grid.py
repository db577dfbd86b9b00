"""A 2D occupancy grid for ROS's map_server: `NAME.yaml` with `NAME.pgm`.

A cell is occupied if enough voxels are between two heights above the ground. A cell is free if ground is observed there
and nothing stands on it, or if a ray of a keyframe to the ground passed over it: beams hit the ground in rings, between
which there are no points. All other cells are unknown. Memory holds one row of tiles.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from scipy.ndimage import distance_transform_edt

from segslam.core.types import GROUND_LABELS, Label, Labels, Mask, Points, Vector
from segslam.output.map.tiles import TILE_M, Part, corner, distance_m

if TYPE_CHECKING:
    from segslam.output.map.write import MapStore

CELL_M = 0.2
"""Chosen: cell size of the occupancy grid (m)."""
MIN_OBSTACLE_VOXELS = 2
"""Chosen: smallest number of such voxels in an occupied cell."""

OCCUPIED, FREE, UNKNOWN = 0, 254, 205
"""Values of the mode `trinary` of map_server; 205 lies between its two thresholds."""
OBSTACLE_M = (0.3, 2.0)
"""Chosen: heights above the ground where a voxel is an obstacle (m)."""
GROUND_CELL_M = 2.0
NUM_DIRECTIONS = 720
"""Chosen: steps of half a degree; one step is a cell of 0.2 m at 23 m."""
REACH_M = 40.0
"""Chosen: at larger ranges, grazing beams leave gaps between rings that may hide obstacles."""


class Grid:
    """Writes the grid; `file` is the .yaml file."""

    def __init__(self, file: Path, store: "MapStore") -> None:
        self._file = file
        self._store = store
        self._cells = round(TILE_M / CELL_M)  # along the edge of a tile
        self._west, east, self._south, self._row = store.tiles.bounds()
        columns, rows = east - self._west + 1, self._row - self._south + 1
        self._band = np.full((self._cells, columns * self._cells), UNKNOWN, np.uint8)
        self._pgm = file.with_suffix(".pgm").open("wb")
        self._pgm.write(f"P5\n{columns * self._cells} {rows * self._cells}\n255\n".encode("ascii"))

    def add(self, part: Part) -> None:
        """Set the cells of a part."""
        self._write_bands_above(part.tile[1])
        left = (part.tile[0] - self._west) * self._cells
        self._band[:, left : left + self._cells] = self._occupancy(part)[::-1]

    def close(self) -> None:
        """Complete both files."""
        self._write_bands_above(self._south - 1)
        self._pgm.close()
        about = {
            "image": self._file.with_suffix(".pgm").name,
            "resolution": TILE_M / self._cells,
            "origin": corner((self._west, self._south)).tolist(),
            "negate": 0,
            "occupied_thresh": 0.65,
            "free_thresh": 0.196,
        }
        self._file.write_text(yaml.safe_dump(about, sort_keys=False), encoding="utf-8")

    def _write_bands_above(self, row: int) -> None:
        while self._row > row:
            self._pgm.write(self._band.tobytes())
            self._band[:] = UNKNOWN
            self._row -= 1

    def _occupancy(self, part: Part) -> np.ndarray:
        """(cells, cells) uint8, the southernmost row first."""
        within = part.points - corner(part.tile)
        column, row = np.clip((within[:, :2] / TILE_M * self._cells).astype(np.int64), 0, self._cells - 1).T
        cell = row * self._cells + column
        obstacles, ground = (
            np.bincount(cell[chosen], minlength=self._cells**2).reshape(self._cells, self._cells)
            for chosen in obstacles_and_ground(within, part.labels, TILE_M)
        )
        occupied = obstacles >= MIN_OBSTACLE_VOXELS
        cells = np.select([occupied, ground > 0], [OCCUPIED, FREE], UNKNOWN).astype(np.uint8)
        rows, columns = np.nonzero(cells == UNKNOWN)
        centres = corner(part.tile)[:2] + (np.column_stack([columns, rows]) + 0.5) * (TILE_M / self._cells)
        for place, free_m in zip(self._store.places, self._store.free_m, strict=True):
            if distance_m(part.tile, place) < REACH_M:
                x, y = (centres - place[:2]).T
                free = np.hypot(x, y) < free_m[_direction(x, y)]
                cells[rows[free], columns[free]] = FREE
        return cells


def free_range_m(points: Points, labels: Labels) -> Vector:
    """(NUM_DIRECTIONS,) free range (m) in each direction, by points (n, 3) of static classes relative to the sensor."""
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
