"""Voxels in square tiles on disk.

Points of several keyframes are collected, merged to voxels and appended to the file of their tile. Tiles are read in
pieces. The files grow with the length of the drive; memory depends only on the surface within one tile.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from segslam.core.types import Indices, Labels, Points, Vector
from segslam.output.map.histogram import Histogram
from segslam.output.map.voxels import MAX_HEIGHT_M, VOXEL, merged

TILE_M = 32.0
"""Chosen: about 100,000 voxels of 0.2 m in a street."""
GATHERED = 1_000_000
"""Number of points merged before writing, and of voxels read at once."""
HEIGHTS_M = np.arange(-MAX_HEIGHT_M, MAX_HEIGHT_M + 0.5, 0.5)
INTENSITIES = np.append(0.0, 2.0 ** np.arange(-10.0, 16.1, 0.125))
"""Steps of 9 % from 0.001 to the largest value of 16 bits, for intensities in any unit."""
SHARES = 0.01, 0.99
"""Share of the voxels, at both ends, that the colour scale ignores as outliers."""

Tile = tuple[int, int]
"""Column (along x) and row (along y)."""


class Tiles:
    """Voxels, stored by tile."""

    def __init__(self, folder: Path, *, voxel_m: float) -> None:
        """`folder` is created; the caller removes it."""
        folder.mkdir()
        self._folder = folder
        self._voxel_m = voxel_m
        self._gathered: list[tuple[Points, Labels, Vector]] = []
        self._num_gathered = 0
        self._known: set[Tile] = set()
        self._heights, self._intensities = Histogram(HEIGHTS_M), Histogram(INTENSITIES)
        self.brightest = 0.0
        """Upper bound of the intensities of the voxels."""

    def add(self, points: Points, labels: Labels, intensities: Vector) -> None:
        """Add points (n, 3) of the world, float64 (m). Points more than 2 km above or below the origin are ignored."""
        near = np.abs(points[:, 2]) < MAX_HEIGHT_M
        self._gathered.append((points[near], labels[near], intensities[near]))
        self._num_gathered += int(near.sum())
        if self._num_gathered >= GATHERED:
            self.flush()

    def flush(self) -> None:
        """Write the collected points to disk."""
        if not self._num_gathered:
            return
        points, labels, intensities = (np.concatenate(parts) for parts in zip(*self._gathered, strict=True))
        self._gathered, self._num_gathered = [], 0
        tiles = np.floor(points[:, :2] / TILE_M).astype(np.int64)
        for tile, rows in _groups(tiles):
            voxels = np.zeros(len(rows), VOXEL)
            voxels["point"] = points[rows] - corner(tile)
            voxels["count"], voxels["label"], voxels["intensity"] = 1, labels[rows], intensities[rows]
            self._append(tile, merged(voxels, self._voxel_m))

    def __len__(self) -> int:
        self.flush()
        return len(self._known)

    def __iter__(self) -> Iterator[Tile]:
        """Tiles that have voxels, by rows from north to south, each row from west to east."""
        self.flush()
        return iter(sorted(self._known, key=lambda tile: (-tile[1], tile[0])))

    def voxels(self, tile: Tile) -> np.ndarray:
        """The VOXEL rows of a tile, one per cell."""
        voxels = np.empty(0, VOXEL)
        with self._file(tile).open("rb") as stream:
            while len(piece := np.fromfile(stream, VOXEL, GATHERED)):
                voxels = merged(np.concatenate([voxels, piece]), self._voxel_m)
        return voxels

    def height_span_m(self) -> tuple[float, float]:
        """Heights (m) below which 1 and 99 % of the written voxels lie, to 0.5 m."""
        return self._heights.span(*SHARES)

    def intensity_span(self) -> tuple[float, float]:
        """Intensities below which those of 1 and 99 % of the written voxels lie, to 9 %."""
        return self._intensities.span(*SHARES)

    def _append(self, tile: Tile, voxels: np.ndarray) -> None:
        self._heights.add(voxels["point"][:, 2])
        self._intensities.add(voxels["intensity"])
        self.brightest = max(self.brightest, float(voxels["intensity"].max()))
        self._known.add(tile)
        with self._file(tile).open("ab") as stream:
            voxels.tofile(stream)

    def _file(self, tile: Tile) -> Path:
        return self._folder / f"{tile[0]}_{tile[1]}.voxels"


def corner(tile: Tile) -> np.ndarray:
    """Corner (x, y, 0) of the tile in the world (m)."""
    return np.array([tile[0] * TILE_M, tile[1] * TILE_M, 0.0])


def distance_m(tile: Tile, place: np.ndarray) -> float:
    """Horizontal distance from a place to the nearest point of a tile; 0 within it."""
    low = corner(tile)[:2]
    outside = np.maximum(np.maximum(low - place[:2], place[:2] - low - TILE_M), 0.0)
    return math.hypot(*outside)


def _groups(tiles: np.ndarray) -> Iterator[tuple[Tile, Indices]]:
    """Each distinct tile, and its rows."""
    order = np.lexsort(tiles.T)
    starts = np.flatnonzero(np.append(True, np.any(np.diff(tiles[order], axis=0), axis=1)))
    for rows in np.split(order, starts[1:]):
        column, row = tiles[rows[0]].tolist()
        yield (column, row), rows
