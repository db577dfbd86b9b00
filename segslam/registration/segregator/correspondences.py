"""Putative correspondences: all pairs of clusters of one class, and mutual nearest neighbours among features.

Yin, Yuan, Cao, Ji, Zhang, Xie, "Segregator: Global Point Cloud Registration with Semantic and Geometric Cues",
ICRA 2023, section III. The tuple test is that of Zhou, Park, Koltun, "Fast Global Registration", ECCV 2016, eq. (2).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from segslam.core.kernels import kernel
from segslam.core.types import Covariances, Description, IndexPairs, Indices, Points

TUPLE_SIMILARITY = 0.95
"""Authors: edge ratio of the tuple test."""
TUPLE_TRIALS_PER_PAIR = 100
"""Authors: random triples drawn for each mutual pair."""
TUPLE_SEED = 0
"""Chosen: random seed of these triples."""

Descriptors = Float[np.ndarray, "_ 33"]


class Correspondences(NamedTuple):
    """Putative correspondences: Gaussian `source_index[i]` of the source may be `target_index[i]` of the target.

    The indices number the clusters first and the features after them.
    """

    source: Points
    target: Points
    source_covariances: Covariances
    target_covariances: Covariances
    source_index: Indices
    target_index: Indices

    @staticmethod
    def of(source: Description, target: Description, pairs: IndexPairs) -> "Correspondences":
        """The Gaussians of two scans in these pairs."""
        sides = []
        for side in (source, target):
            means = np.concatenate([side.means, side.feature_points])
            covariances = np.concatenate([side.covariances, side.feature_covariances])
            sides.append((means.astype(np.float64), covariances.astype(np.float64)))
        (source_means, source_covariances), (target_means, target_covariances) = sides
        i, j = np.ascontiguousarray(pairs.T)
        return Correspondences(source_means[i], target_means[j], source_covariances[i], target_covariances[j], i, j)

    def take(self, rows: Indices) -> "Correspondences":
        """The correspondences in these rows."""
        return Correspondences(*(column[rows] for column in self))


def mutual_nearest(source: Descriptors, target: Descriptors) -> IndexPairs:
    """Pairs of rows that are mutual nearest neighbours, the most similar pair first.

    The order does not depend on which side is the source, nor on the numbering of rows.
    """
    if len(source) == 0 or len(target) == 0:
        return np.empty((0, 2), np.int64)
    nearest_target, squared, nearest_source = _nearest_both_ways(
        source.astype(np.float64), np.ascontiguousarray(target.T, np.float64)
    )
    rows = np.arange(len(source))
    mutual = nearest_source[nearest_target] == rows
    pairs = np.column_stack([rows, nearest_target])[mutual]
    return pairs[np.argsort(squared[mutual], kind="stable")]


def tuple_test(source: Points, target: Points, *, rng: np.random.Generator) -> Indices:
    """Rows, ascending, that are in a random triple whose three edges have nearly equal lengths in both scans.

    Row i of `source` matches row i of `target`. An edge passes if the shorter length is more than `TUPLE_SIMILARITY`
    times the longer length. Returns no rows for fewer than three.
    """
    num_pairs = len(source)
    if num_pairs < 3:
        return np.empty(0, np.int64)
    triples = rng.integers(num_pairs, size=(TUPLE_TRIALS_PER_PAIR * num_pairs, 3))
    similar = _in_similar_triangles(source.astype(np.float64), target.astype(np.float64), triples, TUPLE_SIMILARITY)
    return np.flatnonzero(similar)


def feature_pairs(source: Description, target: Description) -> IndexPairs:
    """Mutual nearest features of one class that pass the tuple test, class after class in ascending order.

    They are numbered as by `Correspondences`.
    """
    rng = np.random.default_rng(TUPLE_SEED)
    kept = [np.empty((0, 2), np.int64)]
    for label in np.intersect1d(source.feature_classes, target.feature_classes):
        source_rows, target_rows = (
            # the descriptors of key points without neighbours are zero
            np.flatnonzero((one.feature_classes == label) & one.feature_descriptors.any(axis=1))
            for one in (source, target)
        )
        pairs = mutual_nearest(source.feature_descriptors[source_rows], target.feature_descriptors[target_rows])
        pairs = np.column_stack([source_rows[pairs[:, 0]], target_rows[pairs[:, 1]]])
        rows = tuple_test(source.feature_points[pairs[:, 0]], target.feature_points[pairs[:, 1]], rng=rng)
        kept.append(pairs[rows])
    return np.concatenate(kept) + np.array([len(source.means), len(target.means)])


@kernel("boolean[::1](float64[:, ::1], float64[:, ::1], int64[:, ::1], float64)")
def _in_similar_triangles(source, target, triples, similarity):
    """Which rows belong to a triple that passes. A row drawn twice makes an edge of length 0, which never passes."""
    passed = np.zeros(len(source), np.bool_)
    for row in range(len(triples)):
        similar = True
        for corner in range(3):
            i, j = triples[row, corner], triples[row, (corner + 1) % 3]
            a = b = 0.0
            for axis in range(3):
                a += (source[i, axis] - source[j, axis]) ** 2
                b += (target[i, axis] - target[j, axis]) ** 2
            similar &= min(a, b) > similarity * similarity * max(a, b)
        if similar:
            for corner in range(3):
                passed[triples[row, corner]] = True
    return passed


@kernel("Tuple((int64[::1], float64[::1], int64[::1]))(float64[:, ::1], float64[:, ::1])")
def _nearest_both_ways(source, target_columns):
    """Nearest target of each source, its squared distance, and nearest source of each target.

    Brute force, one row at a time: in 33 dimensions a search tree visits nearly every leaf, and for small matrices the
    threads of the linear algebra library cost more than they gain.
    """
    count, width = len(source), target_columns.shape[1]
    nearest_target, squared = np.empty(count, np.int64), np.empty(count)
    nearest_source, least = np.zeros(width, np.int64), np.full(width, np.inf)
    row = np.empty(width)
    for i in range(count):
        row[:] = 0.0
        for k in range(source.shape[1]):
            value, column = source[i, k], target_columns[k]
            for j in range(width):
                row[j] += (column[j] - value) ** 2
        nearest_target[i] = np.argmin(row)
        squared[i] = row[nearest_target[i]]
        for j in range(width):
            if row[j] < least[j]:
                nearest_source[j], least[j] = i, row[j]
    return nearest_target, squared, nearest_source
