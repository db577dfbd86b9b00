"""From labels of pixels to labels of points: the pixels around a point, near it in range, vote.

Milioto et al., "RangeNet++: Fast and Accurate LiDAR Semantic Segmentation", IROS 2019, algorithm 1. The point itself
may be hidden behind the one that its pixel shows, and edges in the image bleed onto what lies behind.

Differs from the paper: the image goes on from its last column to its first.
"""

import numpy as np
from jaxtyping import Float, UInt8

from segslam.semantics.network_settings import VoteSettings
from segslam.semantics.range_image import Projection
from segslam.system.kernels import kernel
from segslam.types import Label, Labels


def point_labels(image: UInt8[np.ndarray, "_ _"], projection: Projection, *, settings: VoteSettings) -> Labels:
    """The label that most voters give each point, of equals the smaller; UNLABELLED pixels do not vote.

    Voters are the `neighbours` pixels of the window nearest to the point in range, the distance weighted by nearness
    in the image and within the cutoff. The point's own pixel counts as being at its range.
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
    """One less a Gaussian of unit sum around the middle: what is near in the image seems nearer in range."""
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
