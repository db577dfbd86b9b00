"""The world in square tiles on disk, so that memory holds a few of their voxels however long the drive.

Points of many keyframes are gathered, merged to voxels and appended to the file of their tile; a tile is read back in
pieces. What is on disk grows with the drive, what is in memory with the surface within one tile.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from segslam.map.histogram import Histogram
from segslam.map.voxels import MAX_HEIGHT_M, VOXEL, merged
from segslam.types import Indices, Labels, Points, Vector

TILE_M = 32.0
"""Chosen: some 100,000 voxels of 0.2 m in a street."""
GATHERED = 1_000_000
"""Points that are merged before they go to disk, and voxels that are read at once."""
HEIGHTS_M = np.arange(-MAX_HEIGHT_M, MAX_HEIGHT_M + 0.5, 0.5)
INTENSITIES = np.append(0.0, 2.0 ** np.arange(-10.0, 16.1, 0.125))
"""Steps of 9 %, from a thousandth of 1 to the most that 16 bits hold: sensors have scales of their own."""
SHARES = 0.01, 0.99
"""Of the voxels, between which the colours differ: a few outliers do not take them all."""

Tile = tuple[int, int]
"""Column (along x) and row (along y)."""


class Tiles:
    """Voxels by tile."""

    def __init__(self, folder: Path, *, voxel_m: float) -> None:
        """In a new folder, which the caller removes."""
        folder.mkdir()
        self._folder = folder
        self._voxel_m = voxel_m
        self._gathered: list[tuple[Points, Labels, Vector]] = []
        self._num_gathered = 0
        self._known: set[Tile] = set()
        self._heights, self._intensities = Histogram(HEIGHTS_M), Histogram(INTENSITIES)
        self.brightest = 0.0
        """No voxel's intensity is above it."""

    def add(self, points: Points, labels: Labels, intensities: Vector) -> None:
        """Points of the world, float64 rows in metres; those more than 2 km above or below its origin are left out."""
        near = np.abs(points[:, 2]) < MAX_HEIGHT_M
        self._gathered.append((points[near], labels[near], intensities[near]))
        self._num_gathered += int(near.sum())
        if self._num_gathered >= GATHERED:
            self.flush()

    def flush(self) -> None:
        """Write what is gathered."""
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
        """Tiles with voxels, the northernmost row first, each from west to east: the order of a picture's pixels."""
        self.flush()
        return iter(sorted(self._known, key=lambda tile: (-tile[1], tile[0])))

    def voxels(self, tile: Tile) -> np.ndarray:
        """VOXEL rows of a tile, one a cell."""
        voxels = np.empty(0, VOXEL)
        with self._file(tile).open("rb") as stream:
            while len(piece := np.fromfile(stream, VOXEL, GATHERED)):
                voxels = merged(np.concatenate([voxels, piece]), self._voxel_m)
        return voxels

    def height_span_m(self) -> tuple[float, float]:
        """Heights that 1 and 99 % of the voxels written lie below, to half a metre."""
        return self._heights.span(*SHARES)

    def intensity_span(self) -> tuple[float, float]:
        """Intensities that 1 and 99 % of the voxels written have less than, to 9 %."""
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
    """Where the tile begins, (x, y, 0) in metres of the world."""
    return np.array([tile[0] * TILE_M, tile[1] * TILE_M, 0.0])


def distance_m(tile: Tile, place: np.ndarray) -> float:
    """From a place to the nearest of a tile, seen from above; 0 within."""
    low = corner(tile)[:2]
    outside = np.maximum(np.maximum(low - place[:2], place[:2] - low - TILE_M), 0.0)
    return math.hypot(*outside)


def _groups(tiles: np.ndarray) -> Iterator[tuple[Tile, Indices]]:
    """Each different tile, and the rows that it is in."""
    order = np.lexsort(tiles.T)
    starts = np.flatnonzero(np.append(True, np.any(np.diff(tiles[order], axis=0), axis=1)))
    for rows in np.split(order, starts[1:]):
        column, row = tiles[rows[0]].tolist()
        yield (column, row), rows
