"""A 2D occupancy grid for ROS's map_server: `NAME.yaml` with `NAME.pgm`.

A cell is occupied if enough voxels are between two heights above the ground. A cell is free if ground is observed there
and nothing stands on it, or if a ray of a keyframe to the ground passed over it. All other cells are unknown. Memory
holds one row of tiles.
"""

from pathlib import Path

import numpy as np
import yaml

from segslam.core.config import MapConfig
from segslam.output.map.free_ranges import obstacles_and_ground
from segslam.output.map.part import Extent, Part
from segslam.output.map.tiles import TILE_M, corner

CELL_M = 0.2
"""Chosen: cell size of the occupancy grid (m)."""
MIN_OBSTACLE_VOXELS = 2
"""Chosen: smallest number of such voxels in an occupied cell."""

OCCUPIED, FREE, UNKNOWN = 0, 254, 205
"""Values of the mode `trinary` of map_server; 205 lies between its two thresholds."""
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196


class Grid:
    """Writes the grid; `file` is the .yaml file."""

    def __init__(self, file: Path, extent: Extent, *, config: MapConfig) -> None:
        self._file = file
        self._extent = extent
        self._cells = round(TILE_M / CELL_M)  # along the edge of a tile
        columns, rows = extent.east - extent.west + 1, extent.north - extent.south + 1
        self._band = np.full((self._cells, columns * self._cells), UNKNOWN, np.uint8)
        self._row = extent.north
        self._pgm = file.with_suffix(".pgm").open("wb")
        self._pgm.write(f"P5\n{columns * self._cells} {rows * self._cells}\n255\n".encode("ascii"))

    def add(self, part: Part) -> None:
        """Set the cells of a part."""
        self._write_bands_above(part.tile[1])
        left = (part.tile[0] - self._extent.west) * self._cells
        self._band[:, left : left + self._cells] = self._occupancy(part)[::-1]

    def close(self) -> None:
        """Complete both files."""
        self._write_bands_above(self._extent.south - 1)
        self._pgm.close()
        about = {
            "image": self._file.with_suffix(".pgm").name,
            "resolution": TILE_M / self._cells,
            "origin": [*corner((self._extent.west, self._extent.south)).tolist()],
            "negate": 0,
            "occupied_thresh": OCCUPIED_THRESHOLD,
            "free_thresh": FREE_THRESHOLD,
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
        free = self._extent.free_ranges.is_free(part.tile, centres)
        cells[rows[free], columns[free]] = FREE
        return cells
