"""A scan as an image of the sensor's own view: what convolutional networks for LiDAR take.

As in Milioto et al., "RangeNet++: Fast and Accurate LiDAR Semantic Segmentation", IROS 2019, eq. (1).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int

from segslam.semantics.network_settings import ImageSettings, NetworkSettings
from segslam.types import Indices, Points, Vector

EMPTY = -1
"""No point falls on this pixel."""


class Projection(NamedTuple):
    """Where the points of a scan fall. `rows`, `columns` and `ranges_m` have an entry for each point."""

    rows: Indices
    columns: Indices
    ranges_m: Vector
    nearest: Int[np.ndarray, "_ _"]
    """(height, width) the point on each pixel, the nearest of several, or EMPTY."""

    def image_ranges_m(self) -> Float[np.ndarray, "_ _"]:
        """(height, width) range of each pixel, infinite where there is none."""
        return np.append(self.ranges_m, np.inf)[self.nearest]


def project(points: Points, *, settings: ImageSettings) -> Projection:
    """The pixels of points (n, 3) of the LiDAR frame, finite and off the origin.

    The first column is straight behind, columns go clockwise as seen from above. Points above or below the field of
    view fall on its first or last row.
    """
    ranges_m = np.linalg.norm(points, axis=1)
    low, high = np.radians(settings.field_of_view_deg)
    elevations = np.arcsin(np.clip(points[:, 2] / ranges_m, -1.0, 1.0))
    turns = 0.5 - np.arctan2(points[:, 1], points[:, 0]) / math.tau
    rows = np.clip(np.floor((high - elevations) / (high - low) * settings.height), 0, settings.height - 1)
    columns = np.clip(np.floor(turns * settings.width), 0, settings.width - 1)
    rows, columns = rows.astype(np.int64), columns.astype(np.int64)
    nearest = np.full((settings.height, settings.width), EMPTY, np.int64)
    far_first = np.argsort(-ranges_m, kind="stable")
    nearest[rows[far_first], columns[far_first]] = far_first  # of equal pixels the last assignment stays
    return Projection(rows, columns, ranges_m, nearest)


def network_input(
    points: Points, intensities: Vector, projection: Projection, *, settings: NetworkSettings
) -> Float32[np.ndarray, "1 _ _ _"]:
    """(1, channels, height, width), each channel normalised; pixels without a point are exactly 0 in all of them."""
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
