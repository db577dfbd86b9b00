"""A map from above, as a PNG."""

from pathlib import Path

import matplotlib.image
import numpy as np

from segslam.config import MapConfig
from segslam.map.part import Extent, Part
from segslam.map.tiles import TILE_M, corner

MAX_SIDE = 4000
"""Pixels of the longer side at most; the memory that a picture takes is bounded by it."""
BACKGROUND = 255


class Picture:
    """North (y) is up, and what is highest hides the rest."""

    def __init__(self, file: Path, extent: Extent, *, config: MapConfig) -> None:
        self._file = file
        self._extent = extent
        columns, rows = extent.east - extent.west + 1, extent.north - extent.south + 1
        self._pixels = max(min(round(TILE_M / config.voxel_m), MAX_SIDE // max(columns, rows)), 1)
        self._image = np.full((rows * self._pixels, columns * self._pixels, 3), BACKGROUND, np.uint8)

    def add(self, part: Part) -> None:
        """Draw a part into its square of the picture."""
        order = np.argsort(part.points[:, 2], kind="stable")  # what is written last stays
        inside = (part.points[order] - corner(part.tile))[:, :2] / TILE_M * self._pixels
        column, row = np.clip(inside.astype(np.int64), 0, self._pixels - 1).T
        top = (self._extent.north - part.tile[1]) * self._pixels
        left = (part.tile[0] - self._extent.west) * self._pixels
        square = self._image[top : top + self._pixels, left : left + self._pixels]
        square[self._pixels - 1 - row, column] = part.colors[order]

    def close(self) -> None:
        """Write the picture."""
        matplotlib.image.imsave(self._file, self._image)
