"""The signature of a place: the magnitude spectrum of a scan in top view, nearly invariant to shift and rotation.

The magnitude of the two-dimensional Fourier transform of an image is invariant to a shift of the image and rotates with
the image. Sampled along rays, a rotation is a shift of the rays (Reddy and Chatterji, "An FFT-based technique for
translation, rotation, and scale-invariant image registration", 1996). The magnitudes of a real image are equal on
opposite rays, so the signature determines the yaw up to 180 degrees.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy.fft import rfft2
from scipy.ndimage import map_coordinates

from segslam.core.points import first_rows, voxel_first
from segslam.core.types import Label, Labels, Points, Record, SegslamError
from segslam.labels.geometric import MAX_RANGE_M
from segslam.labels.ground_surface import GROUND_CELL_M, heights_above_ground, rotated, upright

CELL_M = 0.4
HALF = 75
"""Cells from the sensor to the edge of the image: 30 m."""
WINDOW_CELLS = 35.0
"""Standard deviation of the Gaussian weight around the sensor: 14 m."""
_ALONG = np.exp(-0.5 * (np.arange(-HALF, HALF + 1) / WINDOW_CELLS) ** 2)
WINDOW = np.outer(_ALONG, _ALONG)
MAX_LEVELS = 10
"""Largest number of occupied voxels counted per column."""
SIZE = 256
"""Size of the transform in cells; the image is padded with zeros."""
NUM_RADII, MAX_RADIUS = 24, 100
"""Number of circles in the spectrum, evenly spaced; the largest has a wavelength of 1.02 m."""
NUM_ANGLES = 60
"""Number of rays over 180 degrees, 3 degrees apart."""
_ANGLES = np.pi * np.arange(NUM_ANGLES) / NUM_ANGLES - np.pi / 2
_RADII = (np.arange(NUM_RADII) + 1)[:, None] * MAX_RADIUS / NUM_RADII
SAMPLES = np.stack([_RADII * np.sin(_ANGLES), _RADII * np.cos(_ANGLES)])
"""Rows and columns of the transform on the half of each circle where columns are not negative."""
GROUND_M = 0.4
"""Smallest height above the ground of the points used."""
CIRCLES = ((8.0, 6), (16.0, 10))
"""Radius (m) and number of additional viewpoints around the sensor; chosen on scan 4413 of KITTI 00, 12 m beside the
path of a map."""
REACH_M = (HALF + 0.5) * CELL_M
"""Points farther from the sensor than this, in x or in y, are outside the image."""

# All but the last two are chosen on the real places of KITTI 05; 00 was not used.


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PlaceSignature(Record):
    """Signature of a place: one byte per circle and ray of its spectrum."""

    spectrum: UInt8[np.ndarray, "24 60"]
    """Square roots of the magnitudes, scaled to a maximum of 255."""

    def to_bytes(self) -> bytes:
        """The signature as 1,440 bytes."""
        return self.spectrum.tobytes()

    @staticmethod
    def from_bytes(data: bytes) -> "PlaceSignature":
        """The signature from the bytes of `to_bytes`. Raises SegslamError for another length."""
        if len(data) != NUM_RADII * NUM_ANGLES:
            raise SegslamError(f"a signature of {len(data)} bytes; this version uses {NUM_RADII * NUM_ANGLES}")
        return PlaceSignature(np.frombuffer(data, np.uint8).reshape(NUM_RADII, NUM_ANGLES))


def signature_of(points: Points, labels: Labels) -> PlaceSignature:
    """The signature of a scan in its sensor's frame. Labels are used to remove points of moving classes only.

    The sensor may be tilted: the ground is estimated and removed.
    """
    return signature_of_standing(_standing(points, labels, reach_m=REACH_M))


def signatures_around(points: Points, labels: Labels) -> tuple[PlaceSignature, ...]:
    """The signatures of a scan seen from 16 points around its sensor: one of them may be near the path of a map.

    The weight of a point decreases with its distance, so the signature changes over 10 m.
    """
    standing = _standing(points, labels, reach_m=REACH_M + CIRCLES[-1][0])
    return tuple(
        signature_of_standing(standing - [radius_m * math.cos(angle), radius_m * math.sin(angle), 0.0])
        for radius_m, number in CIRCLES
        for angle in math.tau * np.arange(number) / number
    )


def _standing(points: Points, labels: Labels, *, reach_m: float) -> Points:
    """Static points above the ground in a level frame, all of those with x and y below `reach_m`.

    The ground is followed outwards from the sensor, so points two cells farther do not change the heights of these.
    """
    still = points.compress(labels < Label.MOVING_CAR, axis=0)
    thinned = still[voxel_first(still, CELL_M / 2)].astype(np.float64)
    if not len(thinned):
        return thinned
    level = rotated(thinned, upright(thinned))
    edge_m = reach_m + 2 * GROUND_CELL_M
    near = level.compress((np.abs(level[:, 0]) <= edge_m) & (np.abs(level[:, 1]) <= edge_m), axis=0)
    heights = heights_above_ground(near, max_range_m=min(MAX_RANGE_M, edge_m + GROUND_CELL_M))
    return near[heights > GROUND_M]


def signature_of_standing(points: Points) -> PlaceSignature:
    """The signature of points that stand above the ground, in a level frame with the sensor at the origin."""
    magnitudes = np.abs(rfft2(_image(points), (SIZE, SIZE)))
    roots = np.sqrt(map_coordinates(magnitudes, SAMPLES, order=1, mode="grid-wrap"))
    return PlaceSignature(np.rint(255.0 * roots / max(float(roots.max()), 1e-9)).astype(np.uint8))


def _image(points: Points) -> Float[np.ndarray, "size size"]:
    """Square roots of the occupied voxels of each column, weighted by the distance from the sensor."""
    cells = np.rint(points / CELL_M)
    cells = cells[(np.abs(cells) <= [HALF, HALF, 2**15 - 1]).all(axis=1)].astype(np.int64)  # false for NaN
    width = 2 * HALF + 1
    voxels = ((cells[:, 0] + HALF) * width + cells[:, 1] + HALF) * 2**16 + cells[:, 2] + 2**15
    occupied = voxels[first_rows(voxels) == np.arange(len(voxels))]
    counts = np.bincount(occupied >> 16, minlength=width * width).reshape(width, width)
    return (np.sqrt(np.minimum(counts, MAX_LEVELS)) * WINDOW).astype(np.float32)
