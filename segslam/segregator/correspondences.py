"""Putative correspondences: all pairs of clusters of one class, and mutual nearest neighbours among features.

Yin, Yuan, Cao, Ji, Zhang, Xie, "Segregator: Global Point Cloud Registration with Semantic and Geometric Cues",
ICRA 2023, section III. The tuple test is that of Zhou, Park, Koltun, "Fast Global Registration", ECCV 2016, eq. (2).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from segslam.types import Covariances, Description, IndexPairs, Indices, Label, Labels, Points, Vector

Descriptors = Float[np.ndarray, "_ 33"]
BLOCK_ROWS = 1024
"""Chosen: of a distance matrix made at a time, so that 5,000 descriptors take 40 MB and not 200."""


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Row i: the source's Gaussian `source_index[i]` may be the target's `target_index[i]`.

    An index counts clusters first and features after them, so that it names one end of a correspondence.
    """

    source: Points
    target: Points
    source_covariances: Covariances
    target_covariances: Covariances
    source_index: Indices
    target_index: Indices

    def __len__(self) -> int:
        return len(self.source)

    def take(self, rows: Indices) -> "Correspondences":
        """Some of the rows."""
        return Correspondences(*(getattr(self, name)[rows] for name in self.__slots__))


def all_to_all(source_classes: Labels, target_classes: Labels) -> IndexPairs:
    """Every pair of rows whose class is the same, ordered by source row, then by target row."""
    return np.argwhere(source_classes[:, None] == target_classes[None, :])


def mutual_nearest(source: Descriptors, target: Descriptors) -> IndexPairs:
    """Rows that are each other's nearest neighbour, the most similar pair first.

    That order is the same whichever side is called the source and however rows are numbered.
    """
    if len(source) == 0 or len(target) == 0:
        return np.empty((0, 2), np.int64)
    nearest_target, squared = _nearest(source, target)
    nearest_source, _ = _nearest(target, source)
    rows = np.arange(len(source))
    mutual = nearest_source[nearest_target] == rows
    pairs = np.column_stack([rows, nearest_target])[mutual]
    return pairs[np.argsort(squared[mutual], kind="stable")]


def tuple_test(
    source: Points, target: Points, *, similarity: float, trials_per_pair: int, rng: np.random.Generator
) -> Indices:
    """Rows, ascending, that belong to some random triple whose three edges have nearly equal lengths on both sides.

    Row i of `source` matches row i of `target`. An edge passes if the shorter length is more than `similarity` times
    the longer one. Fewer than three rows leave nothing to test: none pass.
    """
    num_pairs = len(source)
    if num_pairs < 3:
        return np.empty(0, np.int64)
    triples = rng.integers(num_pairs, size=(trials_per_pair * num_pairs, 3))
    source_edges, target_edges = _triangle_edges(source[triples]), _triangle_edges(target[triples])
    shorter, longer = np.minimum(source_edges, target_edges), np.maximum(source_edges, target_edges)
    return np.unique(triples[np.all(shorter > similarity * longer, axis=1)])


def _nearest(queries: Descriptors, descriptors: Descriptors) -> tuple[Indices, Vector]:
    """Row of the nearest descriptor to each query, and the squared distance to it.

    By matrix products, a block of queries at a time: at 33 dimensions a search tree visits nearly every leaf.
    """
    transposed = descriptors.astype(np.float64).T
    squared_norms = np.sum(transposed**2, axis=0)
    nearest, squared = np.empty(len(queries), np.int64), np.empty(len(queries))
    for start in range(0, len(queries), BLOCK_ROWS):
        block = queries[start : start + BLOCK_ROWS].astype(np.float64)
        partial = squared_norms - 2.0 * (block @ transposed)
        best = np.argmin(partial, axis=1)
        nearest[start : start + BLOCK_ROWS] = best
        squared[start : start + BLOCK_ROWS] = partial[np.arange(len(block)), best] + np.sum(block**2, axis=1)
    return nearest, squared


def _triangle_edges(corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Lengths of the three edges; a corner drawn twice gives a zero, which never passes."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


def cluster_correspondences(source: Description, target: Description) -> Correspondences:
    """All pairs of clusters of one class."""
    return _collect(source, target, all_to_all(source.classes, target.classes))


def feature_correspondences(
    source: Description, target: Description, *, similarity: float, trials_per_pair: int, seed: int
) -> Correspondences:
    """Mutual nearest features of one class that pass the tuple test, class after class in ascending order."""
    rng = np.random.default_rng(seed)
    kept = [np.empty((0, 2), np.int64)]
    for label in np.intersect1d(source.feature_classes, target.feature_classes):
        pairs = _mutual_nearest_of_class(source, target, Label(label))
        rows = tuple_test(
            source.feature_points[pairs[:, 0]],
            target.feature_points[pairs[:, 1]],
            similarity=similarity,
            trials_per_pair=trials_per_pair,
            rng=rng,
        )
        kept.append(pairs[rows])
    return _collect(source, target, np.concatenate(kept) + np.array([len(source.means), len(target.means)]))


def concatenate(first: Correspondences, second: Correspondences) -> Correspondences:
    """The rows of both."""
    return Correspondences(
        *(np.concatenate([getattr(first, name), getattr(second, name)]) for name in Correspondences.__slots__)
    )


def _mutual_nearest_of_class(source: Description, target: Description, label: Label) -> IndexPairs:
    source_rows, target_rows = _described_rows(source, label), _described_rows(target, label)
    pairs = mutual_nearest(source.feature_descriptors[source_rows], target.feature_descriptors[target_rows])
    return np.column_stack([source_rows[pairs[:, 0]], target_rows[pairs[:, 1]]])


def _described_rows(description: Description, label: Label) -> Indices:
    """Key points of a class, but for those without neighbours, whose descriptors are all zero and so all alike."""
    return np.flatnonzero((description.feature_classes == label) & description.feature_descriptors.any(axis=1))


def _collect(source: Description, target: Description, pairs: IndexPairs) -> Correspondences:
    source_means, source_covariances = _gaussians(source)
    target_means, target_covariances = _gaussians(target)
    i, j = pairs[:, 0], pairs[:, 1]
    return Correspondences(source_means[i], target_means[j], source_covariances[i], target_covariances[j], i, j)


def _gaussians(description: Description) -> tuple[Points, Covariances]:
    means = np.concatenate([description.means, description.feature_points])
    covariances = np.concatenate([description.covariances, description.feature_covariances])
    return means.astype(np.float64), covariances.astype(np.float64)
