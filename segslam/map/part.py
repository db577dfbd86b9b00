"""What the writers of a map are given: its extent first, then part after part."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from segslam.config import MapConfig
from segslam.map.sights import Sights
from segslam.map.tiles import Tile
from segslam.semantics.class_colors import Colors
from segslam.types import Labels, Points, Vector

Window = tuple[float, float, float, float]
"""West, east, south and north end of a picture (m)."""


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """Which tiles a map may have: columns from `west` to `east`, rows from `south` to `north`, those included."""

    west: int
    east: int
    south: int
    north: int
    brightest: float | None
    """No voxel's intensity is above it; None if intensities are not known."""
    path_m: Points
    """Positions of the keyframes in the world, in order."""
    span: tuple[float, float]
    """Of the heights or intensities that the colours show, the ends of the scale."""
    sights: Sights
    """Free space as the keyframes saw it."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """The clean voxels of one tile; `points` (n, 3) float64 in metres of the world."""

    tile: Tile
    points: Points
    labels: Labels
    intensities: Vector
    """Means of the sensor's own numbers; 0 if they are not known."""
    colors: Colors


class MapFile(Protocol):
    """A file of a map while it is written. Parts come row by row, the northernmost first, each from west to east."""

    def __init__(self, file: Path, extent: Extent, *, config: MapConfig) -> None:
        """Begin a file."""

    def add(self, part: Part) -> None:
        """Write the points of a part, or keep what is needed of them."""

    def close(self) -> None:
        """Complete the file."""
