"""Top view of a map, shaded by height: as a PNG with the trajectory, a scale bar and a legend, or as GeoTIFF."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from scipy.ndimage import distance_transform_edt, uniform_filter

from segslam.core.trajectory import parted
from segslam.core.types import Points, SegslamError, Vector
from segslam.labels.encodings import COLORS, Colors
from segslam.output.map.from_above import Window, drawn_map, visible
from segslam.output.map.tiles import TILE_M, Part, corner

if TYPE_CHECKING:
    from segslam.output.map.write import MapStore

MAX_SIDE = 4000
"""Largest number of pixels along the longer side; limits the memory."""
MARGIN_M = 4.0
SHADED_M = 3.0
"""Chosen: the shading of a height is relative to the mean height in a square of this size."""
GAP_PX = 1.5
"""Chosen: a pixel is filled if one of its 8 neighbours is known."""
BAND_PX = 256
"""Rows of the image that are shaded at once; the result does not depend on it."""
RELIEF_M, CONTRAST = 1.5, 0.35
"""Chosen: height difference with strong shading, and strength of the shading."""
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


class Picture:
    """Top view with north (y) up; the highest point of a pixel is visible, below ceilings: see `cut_heights`."""

    def __init__(self, file: Path, store: "MapStore") -> None:
        self._file = file
        self._store = store
        beside = (store.path_m[:, :2] + margin_m for margin_m in (-MARGIN_M, MARGIN_M))
        tiles = np.vstack([list(store.tiles), *(np.floor(xy_m / TILE_M) for xy_m in beside)]).astype(np.int64)
        (self._west, self._south), (east, self._north) = tiles.min(axis=0).tolist(), tiles.max(axis=0).tolist()
        columns, rows = east - self._west + 1, self._north - self._south + 1
        self._pixels = max(min(round(TILE_M / store.config.voxel_m), MAX_SIDE // max(columns, rows)), 1)
        size = rows * self._pixels, columns * self._pixels
        self._image = np.full((*size, 3), 255, np.uint8)  # white
        self._height_m = np.full(size, np.nan, np.float32)
        self._labels: set[int] = set()

    def add(self, part: Part) -> None:
        """Draw a part into its area of the image."""
        seen = np.flatnonzero(visible(part.points, self._store.path_m, self._store.cut_m))
        order = seen[np.argsort(part.points[seen, 2], kind="stable")]  # the last assignment to a pixel remains
        inside = (part.points[order] - corner(part.tile))[:, :2] / TILE_M * self._pixels
        column, row = np.clip(inside.astype(np.int64), 0, self._pixels - 1).T
        top = (self._north - part.tile[1]) * self._pixels
        left = (part.tile[0] - self._west) * self._pixels
        square = np.s_[top : top + self._pixels, left : left + self._pixels]
        self._image[square][self._pixels - 1 - row, column] = part.colors[order]
        self._height_m[square][self._pixels - 1 - row, column] = part.points[order, 2]
        self._labels |= set(np.unique(part.labels[order]).tolist())

    def close(self) -> None:
        """Write the image."""
        image, window, _ = self._finished()
        del self._image, self._height_m  # drawing needs as much memory again
        titles = {"class": "class", "height": "height (m)", "intensity": "intensity"}
        title, path_m = titles[self._store.config.color], parted(self._store.path_m, self._store.begun)
        self._file.write_bytes(drawn_map(image, window, path_m=path_m, title=title, marks=self._marks()))

    def _finished(self) -> tuple[np.ndarray, Window, float]:
        """The shaded image (rows, columns, 3) of points and path, its window, and the median height of its pixels."""
        known, margin = np.isfinite(self._height_m), round(MARGIN_M * self._pixels / TILE_M)
        if not known.any():
            raise SegslamError("map in top view: nothing is seen below the ceiling; write a cloud (.ply) instead")
        west, south, _ = corner((self._west, self._south)).tolist()
        column, row = ((self._store.path_m[:, :2] - (west, south)) / TILE_M * self._pixels).astype(np.int64).T
        known[len(known) - 1 - row, column] = True  # the path is shown whole, also where the sensor saw nothing near it
        ends = (np.flatnonzero(known.any(axis=axis))[[0, -1]].tolist() for axis in (1, 0))
        (top, bottom), (left, right) = (
            (max(first - margin, 0), min(last + 1 + margin, size))
            for (first, last), size in zip(ends, known.shape, strict=True)
        )
        area = np.s_[top:bottom, left:right]
        shading_px = max(round(SHADED_M * self._pixels / TILE_M), 3)
        image, height_m = closed_and_shaded(self._image[area], self._height_m[area], shading_px)
        pixel_m, height = TILE_M / self._pixels, len(known)
        east_west = west + left * pixel_m, west + right * pixel_m
        window = (*east_west, south + (height - bottom) * pixel_m, south + (height - top) * pixel_m)
        return image, window, float(np.nanmedian(height_m))

    def _marks(self) -> list[tuple[str, str]]:
        """Text and colour of each class in the map, or of values along the colour scale."""
        if self._store.config.color == "class":
            return [(label.name.lower().replace("_", " "), COLORS[label]) for label in COLORS if label in self._labels]
        low, high = span = self._store.span()
        values = np.linspace(high, low, 6)
        colors = of_numbers(values, span=span)
        return [(f"{value:.3g}", f"#{bytes(color).hex()}") for value, color in zip(values, colors, strict=True)]


def closed_and_shaded(image: np.ndarray, height_m: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours and heights with gaps filled, and the colours shaded, band by band: a large image takes little memory."""
    shades, heights = np.empty_like(image), np.empty_like(height_m)
    around = window // 2 + math.ceil(GAP_PX)
    for first in range(0, len(image), BAND_PX):
        low, last = max(first - around, 0), first + BAND_PX
        colors, filled_m = closed(image[low : last + around], height_m[low : last + around])
        band = slice(first - low, first - low + BAND_PX)
        shades[first:last], heights[first:last] = shaded(colors, filled_m, window)[band], filled_m[band]
    return shades, heights


def closed(image: np.ndarray, height_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours and heights with gaps between points filled from a known neighbouring pixel."""
    away, nearest = distance_transform_edt(np.isnan(height_m), return_indices=True)
    fill = away < GAP_PX
    rows, columns = (place[fill] for place in nearest)
    full, heights = image.copy(), height_m.copy()
    full[fill], heights[fill] = image[rows, columns], height_m[rows, columns]
    return full, heights


def shaded(image: np.ndarray, height_m: np.ndarray, window: int) -> np.ndarray:
    """Colours (rows, columns, 3), brighter above and darker below the mean of known heights within `window` pixels."""
    known = np.isfinite(height_m)
    weight = uniform_filter(known.astype(np.float32), window)
    mean = uniform_filter(np.where(known, height_m, 0.0).astype(np.float32), window) / np.maximum(weight, 1e-6)
    relief = np.tanh(np.where(known, height_m - mean, 0.0) / RELIEF_M)
    factor = np.where(known, 1.0 + CONTRAST * relief, 1.0)[..., None]
    return np.clip(image * factor, 0, 255).astype(np.uint8)


def of_numbers(values: Vector, *, span: tuple[float, float]) -> Colors:
    """Colours (n, 3) from dark violet, at the start of the span and below, to yellow, at its end and above."""
    low, high = span
    table = (255 * colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3]).astype(np.uint8)
    share = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    return table[(share * (len(table) - 1)).astype(np.int64)]


class GeoTiff(Picture):
    """The top view without legend as GeoTIFF in UTM; needs the origin of a georeferenced run."""

    def close(self) -> None:
        """Write the image."""
        import rasterio
        from rasterio.transform import Affine

        from segslam.gnss.geodesy import utm

        origin = self._store.origin
        assert origin is not None, "checked before the map is made"
        epsg, projected = utm(origin)
        image, window, height_m = self._finished()
        rows, columns = image.shape[:2]
        with rasterio.open(
            self._file,
            "w",
            driver="GTiff",
            height=rows,
            width=columns,
            count=3,
            dtype="uint8",
            crs=f"EPSG:{epsg}",
            transform=Affine(*_affine(projected, window, rows, columns, height_m).ravel()),
            compress="deflate",
            photometric="RGB",
        ) as file:
            file.write(image.transpose(2, 0, 1))


def _affine(projected: Callable[[Points], Points], window: Window, rows: int, columns: int, height_m: float) -> Points:
    """(2, 3) map from column and row to UTM: exact to a centimetre within a few kilometres.

    UTM turns and scales the local frame; its curvature is 4 mm over a kilometre, far from the central meridian.
    """
    west, east, south, north = window
    places = np.column_stack(
        [west + CORNERS[:, 0] * (east - west), north - CORNERS[:, 1] * (north - south), np.full(4, height_m)]
    )
    pixels = np.column_stack([CORNERS * [columns, rows], np.ones(4)])
    solution, *_ = np.linalg.lstsq(pixels, projected(places)[:, :2], rcond=None)
    return solution.T
