"""Input of the map writers: the extent of the map, then its parts; and colours by height or intensity."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from segslam.core.config import MapConfig
from segslam.core.types import Labels, Points, Vector
from segslam.labels.encodings import Colors
from segslam.output.map.tiles import Tile

if TYPE_CHECKING:
    from segslam.gnss.geodesy import Origin
    from segslam.output.map.grid import FreeRanges


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """Range of tiles of a map: columns `west` to `east`, rows `south` to `north`, all included."""

    west: int
    east: int
    south: int
    north: int
    brightest: float | None
    """Upper bound of the intensities; None if intensities are unknown."""
    path_m: Points
    """Positions of the keyframes in the world, in order (m)."""
    config: MapConfig
    span: tuple[float, float]
    """Both ends of the colour scale, for heights or intensities."""
    free_ranges: "FreeRanges"
    """Free space observed by the keyframes."""
    cut_m: Vector | None = None
    """Heights (n,) of `from_above.cut_heights` for each position of the path; None if no picture is drawn."""
    origin: "Origin | None" = None
    """Place of the world frame (east, north, up) on the globe, if it is known."""


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


def of_numbers(values: Vector, *, span: tuple[float, float]) -> Colors:
    """Colours (n, 3) from dark violet, at the start of the span and below, to yellow, at its end and above."""
    from matplotlib import colormaps

    low, high = span
    table = (255 * colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3]).astype(np.uint8)
    share = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    return table[(share * (len(table) - 1)).astype(np.int64)]
