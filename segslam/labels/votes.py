"""Labels of points from labels of pixels: k-nearest-neighbour voting in the range image.

Milioto et al., "RangeNet++: Fast and Accurate LiDAR Semantic Segmentation", IROS 2019, algorithm 1. Voting is needed
because several points share a pixel, and because networks blur edges in the image.

Differs from the paper: the image wraps around at its last column.
"""

import numpy as np
from jaxtyping import Float, UInt8

from segslam.core.kernels import kernel
from segslam.core.types import Label, Labels
from segslam.labels.network_settings import VoteSettings
from segslam.labels.range_image import Projection


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
