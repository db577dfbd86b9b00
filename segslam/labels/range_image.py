"""Range images: a scan projected to an image around the sensor, the input of networks, and votes on the points' labels.

Milioto et al., "RangeNet++: Fast and Accurate LiDAR Semantic Segmentation", IROS 2019, eq. (1) and algorithm 1. The
k nearest neighbours in the image vote because several points share a pixel, and because networks blur edges in it.

Differs from the paper: the image wraps around at its last column.
"""

import math

import numpy as np
from jaxtyping import Float, Float32, UInt8

from segslam.core import geometry
from segslam.core.kernels import kernel
from segslam.core.types import Label, Labels, Points, Vector
from segslam.labels.network_settings import ImageSettings, NetworkSettings, VoteSettings

EMPTY = -1
"""Value of a pixel without a point."""


class Projection:
    """The pixels of points (n, 3) of the LiDAR frame. Points must be finite and not at the origin.

    The first column is behind the sensor; columns go clockwise as seen from above. Points above or below the field of
    view are assigned to the first or last row.
    """

    def __init__(self, points: Points, *, settings: ImageSettings) -> None:
        self.ranges_m, elevations, azimuths = geometry.spherical(points)
        low, high = np.radians(settings.field_of_view_deg)
        turns = 0.5 - azimuths / math.tau
        rows = np.clip(np.floor((high - elevations) / (high - low) * settings.height), 0, settings.height - 1)
        columns = np.clip(np.floor(turns * settings.width), 0, settings.width - 1)
        self.rows, self.columns = rows.astype(np.int64), columns.astype(np.int64)
        self.nearest = np.full((settings.height, settings.width), EMPTY, np.int64)
        """(height, width) index of the nearest point in each pixel, or EMPTY."""
        far_first = np.argsort(-self.ranges_m, kind="stable")
        self.nearest[self.rows[far_first], self.columns[far_first]] = far_first  # the last assignment remains

    def image_ranges_m(self) -> Float[np.ndarray, "_ _"]:
        """(height, width) range of each pixel, infinite for empty pixels."""
        return np.append(self.ranges_m, np.inf)[self.nearest]


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


def point_labels(image: UInt8[np.ndarray, "_ _"], projection: Projection, *, settings: VoteSettings) -> Labels:
    """The majority label of each point; the smallest of equals. UNLABELLED pixels do not vote.

    The voters of a point are the `neighbours` pixels of the window with the smallest weighted range differences, as far
    as these are at most `cutoff_m`. The range difference of the point's own pixel is 0.
    """
    return _vote(
        np.ascontiguousarray(image, dtype=np.uint8),
        projection.image_ranges_m().astype(np.float64),
        projection.rows,
        projection.columns,
        projection.ranges_m.astype(np.float64),
        window_weights(settings.window, settings.sigma_px),
        settings.neighbours,
        settings.cutoff_m,
        len(Label),
    )


def window_weights(side: int, sigma_px: float) -> Float[np.ndarray, "side side"]:
    """Weights of range differences: 1 minus a Gaussian of unit sum, so that pixels near in the image are preferred."""
    offsets = np.arange(side) - side // 2
    bell = np.exp(-0.5 * (offsets / sigma_px) ** 2)
    return 1.0 - np.outer(bell, bell) / bell.sum() ** 2


@kernel("uint8[:](uint8[:, :], float64[:, :], int64[:], int64[:], float64[:], float64[:, :], int64, float64, int64)")
def _vote(image, image_ranges, rows, columns, ranges, weights, num_neighbours, cutoff, num_labels):
    height, width = image.shape
    half = len(weights) // 2
    labels = np.empty(len(rows), np.uint8)
    distances, voters = np.empty(num_neighbours), np.empty(num_neighbours, np.uint8)
    votes = np.empty(num_labels, np.int64)
    for point in range(len(rows)):
        distances[:] = np.inf
        for down in range(-half, half + 1):
            row = rows[point] + down
            if row < 0 or row >= height:
                continue
            for right in range(-half, half + 1):
                column = (columns[point] + right) % width
                off = 0.0 if down == 0 and right == 0 else abs(image_ranges[row, column] - ranges[point])
                off *= weights[down + half, right + half]
                at = num_neighbours - 1
                if off >= distances[at]:
                    continue
                while at > 0 and distances[at - 1] > off:
                    distances[at], voters[at] = distances[at - 1], voters[at - 1]
                    at -= 1
                distances[at], voters[at] = off, image[row, column]
        votes[:] = 0
        for at in range(num_neighbours):
            if distances[at] <= cutoff:
                votes[voters[at]] += 1
        votes[0] = 0
        labels[point] = np.argmax(votes)
    return labels
