"""Range images: a scan projected to an image around the sensor, the input of convolutional LiDAR networks.

Milioto et al., "RangeNet++: Fast and Accurate LiDAR Semantic Segmentation", IROS 2019, eq. (1).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int

from segslam.core import geometry
from segslam.core.types import Indices, Points, Vector
from segslam.labels.network_settings import ImageSettings, NetworkSettings

EMPTY = -1
"""Value of a pixel without a point."""


class Projection(NamedTuple):
    """The pixel of each point of a scan. `rows`, `columns` and `ranges_m` have one entry per point."""

    rows: Indices
    columns: Indices
    ranges_m: Vector
    nearest: Int[np.ndarray, "_ _"]
    """(height, width) index of the nearest point in each pixel, or EMPTY."""

    def image_ranges_m(self) -> Float[np.ndarray, "_ _"]:
        """(height, width) range of each pixel, infinite for empty pixels."""
        return np.append(self.ranges_m, np.inf)[self.nearest]


def project(points: Points, *, settings: ImageSettings) -> Projection:
    """The pixels of points (n, 3) of the LiDAR frame. Points must be finite and not at the origin.

    The first column is behind the sensor; columns go clockwise as seen from above. Points above or below the field of
    view are assigned to the first or last row.
    """
    ranges_m, elevations, azimuths = geometry.spherical(points)
    low, high = np.radians(settings.field_of_view_deg)
    turns = 0.5 - azimuths / math.tau
    rows = np.clip(np.floor((high - elevations) / (high - low) * settings.height), 0, settings.height - 1)
    columns = np.clip(np.floor(turns * settings.width), 0, settings.width - 1)
    rows, columns = rows.astype(np.int64), columns.astype(np.int64)
    nearest = np.full((settings.height, settings.width), EMPTY, np.int64)
    far_first = np.argsort(-ranges_m, kind="stable")
    nearest[rows[far_first], columns[far_first]] = far_first  # the last assignment to a pixel remains
    return Projection(rows, columns, ranges_m, nearest)


def network_input(
    points: Points, intensities: Vector, projection: Projection, *, settings: NetworkSettings
) -> Float32[np.ndarray, "1 _ _ _"]:
    """(1, channels, height, width), with each channel normalised; all channels are 0 in pixels without a point."""
    x, y, z = points.T
    source = {
        "range": projection.ranges_m,
        "x": x,
        "y": y,
        "z": z,
        "intensity": intensities,
        "mask": np.ones(len(points)),
    }
    filled = projection.nearest != EMPTY
    at = projection.nearest[filled]
    image = np.zeros((1, len(settings.channels), *filled.shape), np.float32)
    for number, (name, mean, std) in enumerate(zip(settings.channels, settings.mean, settings.std, strict=True)):
        image[0, number, filled] = (source[name][at] - mean) / std
    return image
