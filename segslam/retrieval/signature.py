"""The signature of a place: the spectrum of the scan seen from above, which a shift or a turn hardly changes.

The magnitude of the two-dimensional Fourier transform of an image does not change when the image is shifted, and turns
when the image is turned; sampled along rays, a turn is a shift of the rays (Reddy and Chatterji, "An FFT-based
technique for translation, rotation, and scale-invariant image registration", 1996). A real image has the same
magnitude on opposite rays, so the signature determines the yaw up to half a turn.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, UInt8
from scipy.fft import rfft2
from scipy.ndimage import map_coordinates

from segslam.config import GeometricLabelsConfig
from segslam.points import voxel_first
from segslam.semantics.ground_surface import heights_above_ground, turned, upright
from segslam.system.short_repr import Record
from segslam.types import Label, Labels, Points, SegslamError

CELL_M = 0.4
HALF = 75
"""Cells from the sensor to the edge of the image: 30 m."""
WINDOW_CELLS = 35.0
"""Standard deviation of the Gaussian weight around the sensor: 14 m."""
MAX_LEVELS = 10
"""Most occupied voxels of a column that count."""
SIZE = 256
"""Cells of the transform, with zeros around the image."""
NUM_RADII, MAX_RADIUS = 24, 100
"""Circles of the spectrum, evenly spaced; the largest has a wavelength of 1.02 m."""
NUM_ANGLES = 60
"""Rays of half a turn, 3 degrees apart."""
GROUND_M = 0.4
"""Points lower above the ground do not count."""
CIRCLES = ((8.0, 6), (16.0, 10))
"""Radius (m) and number of the points from which a place is looked at besides the sensor's; chosen on scan 4413 of
KITTI 00, 12 m beside the path of a map."""

# All but the last two of these are chosen on the real places of KITTI 05; 00 was not used.


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PlaceSignature(Record):
    """Signature of a place: a byte for each circle and ray of its spectrum."""

    spectrum: UInt8[np.ndarray, "24 60"]
    """Square roots of the magnitudes, 255 for the greatest."""

    def to_bytes(self) -> bytes:
        """1,440 bytes."""
        return self.spectrum.tobytes()

    @staticmethod
    def from_bytes(data: bytes) -> "PlaceSignature":
        """The signature that `to_bytes` wrote. Raises SegslamError for another length."""
        if len(data) != NUM_RADII * NUM_ANGLES:
            raise SegslamError(f"a signature of {len(data)} bytes; this version has {NUM_RADII * NUM_ANGLES}")
        return PlaceSignature(np.frombuffer(data, np.uint8).reshape(NUM_RADII, NUM_ANGLES))


def signature_of(points: Points, labels: Labels, *, config: GeometricLabelsConfig) -> PlaceSignature:
    """The signature of a scan in its sensor's frame; of labels, only those of moving things are used.

    The sensor may lean: the ground is found and left out.
    """
    return signature_of_standing(_standing(points, labels, config))


def signatures_around(points: Points, labels: Labels, *, config: GeometricLabelsConfig) -> tuple[PlaceSignature, ...]:
    """Those of a scan, seen from 16 points around its sensor: one of them may be near the path of a map.

    As the weight of a point falls with its distance, a place seen from 10 m beside has another signature.
    """
    standing = _standing(points, labels, config)
    return tuple(signature_of_standing(standing - centre) for centre in _centres())


def _standing(points: Points, labels: Labels, config: GeometricLabelsConfig) -> Points:
    """What stands still above the ground, in a level frame."""
    still = points.compress((labels < Label.MOVING_CAR) & np.isfinite(points).all(axis=1), axis=0)
    if not len(still):
        return still
    thinned = still[voxel_first(still, CELL_M / 2)].astype(np.float64)
    level = turned(thinned, upright(thinned))
    heights = heights_above_ground(
        level, cell_m=config.ground_cell_m, max_range_m=config.max_range_m, max_slope=config.max_slope
    )
    return level[heights > GROUND_M]


@cache
def _centres() -> Points:
    """Where a place is looked at from besides the sensor's own."""
    return np.array(
        [
            [radius_m * math.cos(angle), radius_m * math.sin(angle), 0.0]
            for radius_m, number in CIRCLES
            for angle in math.tau * np.arange(number) / number
        ]
    )


def signature_of_standing(points: Points) -> PlaceSignature:
    """The signature of points that stand above the ground, in a level frame with the sensor at the origin."""
    magnitudes = np.abs(rfft2(_image(points), (SIZE, SIZE)))
    roots = np.sqrt(map_coordinates(np.pad(magnitudes, ((0, 0), (0, 1))), _samples(), order=1, mode="grid-wrap"))
    return PlaceSignature(np.rint(255.0 * roots / max(float(roots.max()), 1e-9)).astype(np.uint8))


def _image(points: Points) -> Float[np.ndarray, "size size"]:
    """Square roots of the occupied voxels of each column, weighted by the distance from the sensor."""
    cells = np.rint(points / CELL_M).astype(np.int64)
    cells = cells[(np.abs(cells[:, :2]) <= HALF).all(axis=1)]
    width = 2 * HALF + 1
    voxels = np.unique(((cells[:, 0] + HALF) * width + cells[:, 1] + HALF) * 2**16 + cells[:, 2] + 2**15)
    counts = np.bincount(voxels >> 16, minlength=width * width).reshape(width, width)
    return (np.sqrt(np.minimum(counts, MAX_LEVELS)) * _window()).astype(np.float32)


@cache
def _window() -> Float[np.ndarray, "size size"]:
    along = np.exp(-0.5 * (np.arange(-HALF, HALF + 1) / WINDOW_CELLS) ** 2)
    return np.outer(along, along)


@cache
def _samples() -> Float[np.ndarray, "2 radii angles"]:
    """Rows and columns of the transform on the half of each circle where columns are not negative."""
    angles = np.pi * np.arange(NUM_ANGLES) / NUM_ANGLES - np.pi / 2
    radii = (np.arange(NUM_RADII) + 1)[:, None] * MAX_RADIUS / NUM_RADII
    return np.stack([radii * np.sin(angles), radii * np.cos(angles)])
