"""Voxels in square tiles on disk: mean point and intensity, number of points, and most frequent class.

Points of several keyframes are collected, merged to voxels and appended to the file of their tile. Tiles are read in
pieces. The files grow with the length of the drive; memory depends only on the surface within one tile. The writers of
maps get a `Part` for each tile.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segslam.core.points import first_rows
from segslam.core.types import Indices, Labels, Points, Vector
from segslam.labels.encodings import Colors

VOXEL = np.dtype([("point", "<f4", 3), ("count", "<u4"), ("label", "u1"), ("intensity", "<f4")])
"""`point` (m): x and y from the corner of the tile, z in the world."""
NUM_LABELS = 32
"""Larger than the number of classes."""
MAX_HEIGHT_M = 2000.0
"""Largest height of a point, above or below the origin."""

TILE_M = 32.0
"""Chosen: about 100,000 voxels of 0.2 m in a street."""
GATHERED = 1_000_000
"""Number of points merged before writing, and of voxels read at once."""
HEIGHTS_M = np.arange(-MAX_HEIGHT_M, MAX_HEIGHT_M + 0.5, 0.5)
INTENSITIES = np.append(0.0, 2.0 ** np.arange(-10.0, 16.1, 0.125))
"""Steps of 9 % from 0.001 to the largest value of 16 bits, for intensities in any unit."""
Tile = tuple[int, int]
"""Column (along x) and row (along y)."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """The clean voxels of one tile; `points` (n, 3) float64 in the world (m).

    Parts come by rows from north to south, each row from west to east.
    """

    tile: Tile
    points: Points
    labels: Labels
    intensities: Vector
    """Mean intensity in the sensor's unit; 0 if unknown."""
    colors: Colors


class Histogram:
    """Counts numbers between fixed edges. Numbers beyond the outermost edges count in the outermost bins."""

    def __init__(self, edges: Vector) -> None:
        self._edges = edges
        self._counts = np.zeros(len(edges) - 1, np.int64)

    def add(self, values: Vector) -> None:
        """Count these numbers."""
        bins = np.searchsorted(self._edges[1:-1], values, side="right")
        self._counts += np.bincount(bins, minlength=len(self._counts))

    def span(self, low_share: float, high_share: float) -> tuple[float, float]:
        """Edges of the bins that contain two quantiles: the lower edge for `low_share`, the upper for `high_share`."""
        shares = np.cumsum(self._counts) / max(self._counts.sum(), 1)
        low, high = np.searchsorted(shares, (low_share, high_share))
        return float(self._edges[low]), float(self._edges[high + 1])


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
        self.heights, self.intensities = Histogram(HEIGHTS_M), Histogram(INTENSITIES)
        """Of the written voxels: to 0.5 m, and to 9 %."""
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
            voxels = merged(voxels, self._voxel_m)
            self.heights.add(voxels["point"][:, 2])
            self.intensities.add(voxels["intensity"])
            self.brightest = max(self.brightest, float(voxels["intensity"].max()))
            self._known.add(tile)
            with self._file(tile).open("ab") as stream:
                voxels.tofile(stream)

    def __len__(self) -> int:
        self.flush()
        return len(self._known)

    def __iter__(self) -> Iterator[Tile]:
        """Tiles that have voxels, by rows from north to south, each row from west to east."""
        self.flush()
        return iter(sorted(self._known, key=lambda tile: (-tile[1], tile[0])))

    def bounds(self) -> tuple[int, int, int, int]:
        """First and last column, first and last row of the tiles that have voxels; there is one at least."""
        (west, south), (east, north) = np.min(list(self), axis=0).tolist(), np.max(list(self), axis=0).tolist()
        return west, east, south, north

    def voxels(self, tile: Tile) -> np.ndarray:
        """The VOXEL rows of a tile, one per cell."""
        voxels = np.empty(0, VOXEL)
        with self._file(tile).open("rb") as stream:
            while len(piece := np.fromfile(stream, VOXEL, GATHERED)):
                voxels = merged(np.concatenate([voxels, piece]), self._voxel_m)
        return voxels

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


def merged(voxels: np.ndarray, voxel_m: float) -> np.ndarray:
    """VOXEL rows, merged to one row per cell: means weighted by count, and the class with the most points.

    Ties between classes are resolved to the smallest id. Cells are in the order of their first occurrence.
    """
    first = first_rows(_cell_keys(voxels["point"], voxel_m))
    is_first = first == np.arange(len(voxels))
    cells, num_cells = (np.cumsum(is_first) - 1)[first], int(is_first.sum())
    result = np.zeros(num_cells, VOXEL)
    weights = voxels["count"].astype(np.float64)
    counts = np.bincount(cells, weights, minlength=num_cells)
    means = [*result["point"].T, result["intensity"]]
    for mean, values in zip(means, [*voxels["point"].T, voxels["intensity"]], strict=True):
        mean[:] = np.bincount(cells, weights * values, minlength=num_cells) / np.maximum(counts, 1)
    result["count"] = counts
    result["label"] = _commonest_labels(cells, voxels["label"], weights)
    return result


def _cell_keys(points: np.ndarray, voxel_m: float) -> Indices:
    """A number for each point's cell, floor(p / voxel_m); tiles are less than 2^20 cells wide."""
    x, y = (np.floor(points[:, axis] / voxel_m).astype(np.int64) + 1 for axis in range(2))  # -1 by rounding at a border
    z = np.floor((points[:, 2] + MAX_HEIGHT_M) / voxel_m).astype(np.int64)
    return (x << 42) | (y << 21) | z


def _commonest_labels(cells: Indices, labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(num_cells,) uint8 label with the largest weight in each cell."""
    pairs, numbers = np.unique(cells * NUM_LABELS + labels, return_inverse=True)
    counts = np.bincount(numbers, weights)
    cell, label = np.divmod(pairs, NUM_LABELS)
    order = np.lexsort((-label, counts, cell))
    last_of_cell = np.append(np.diff(cell[order]) > 0, True) if len(order) else np.zeros(0, bool)
    return label[order[last_of_cell]].astype(np.uint8)
