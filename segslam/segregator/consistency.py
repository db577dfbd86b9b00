"""G-TRIM: the graph that joins correspondences which one rigid motion could explain together.

Yin et al., "Segregator", ICRA 2023, section III-C. For correspondences i, j between source Gaussians a and target
Gaussians b, the translation- and rotation-invariant measurement of each side is N(mu_i - mu_j, Sigma_i + Sigma_j).

| here | paper |
|---|---|
| length test | abs(abs(mu_a) - abs(mu_b)) <= beta, the l-TRIM of TEASER (Yang, Shi, Carlone, T-RO 2021) |
| published gate | tr(Sa + Sb - 2 (Sa^1/2 Sb Sa^1/2)^1/2) <= bound, the shape term of the squared Wasserstein distance |
| invariant gate | sum_k (sqrt(lambda_k(Sa)) - sqrt(lambda_k(Sb)))^2 <= bound, its minimum over all rotations |

Differs from the paper: its mean term compares vectors of two frames; the length test takes its place, as in the
authors' program. Correspondences that share an end are never joined: one thing cannot be in two places.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt64
from numba import njit

from segslam.config import SegregatorConfig
from segslam.segregator.correspondences import Correspondences
from segslam.types import IndexPairs

Bits = UInt64[np.ndarray, "_ _"]
"""Adjacency, a row a vertex: bit k of word w says whether there is an edge to vertex 64 w + k."""


@dataclass(frozen=True, slots=True, eq=False)
class ConsistencyGraph:
    """A vertex for each correspondence."""

    adjacency: Bits
    num_edges: int

    def __len__(self) -> int:
        return len(self.adjacency)


def consistency_graph(correspondences: Correspondences, *, config: SegregatorConfig) -> ConsistencyGraph:
    """The graph of l-TRIM and the gate that the configuration names."""
    adjacency = _length_consistent(
        correspondences.source,
        correspondences.target,
        correspondences.source_index,
        correspondences.target_index,
        config.length_bound_m,
    )
    if config.gate != "lengths":
        keep_similar = _keep_similar_spectra if config.gate == "invariant" else _keep_similar_shapes
        keep_similar(
            adjacency,
            correspondences.source_covariances,
            correspondences.target_covariances,
            config.shape_bound_m2,
        )
    return ConsistencyGraph(adjacency, int(np.bitwise_count(adjacency).sum()) // 2)


def edges(graph: ConsistencyGraph) -> IndexPairs:
    """Joined pairs i < j, in ascending order."""
    flags = np.unpackbits(graph.adjacency.view(np.uint8), axis=1, count=len(graph), bitorder="little")
    return np.argwhere(np.triu(flags, 1))


@njit(cache=True, nogil=True, inline="always")
def _joined(adjacency, i, j):
    return (adjacency[i, j >> 6] >> np.uint64(j & 63)) & np.uint64(1)


@njit(cache=True, nogil=True, inline="always")
def _join(adjacency, i, j):
    adjacency[i, j >> 6] |= np.uint64(1) << np.uint64(j & 63)
    adjacency[j, i >> 6] |= np.uint64(1) << np.uint64(i & 63)


@njit(cache=True, nogil=True, inline="always")
def _part(adjacency, i, j):
    adjacency[i, j >> 6] &= ~(np.uint64(1) << np.uint64(j & 63))
    adjacency[j, i >> 6] &= ~(np.uint64(1) << np.uint64(i & 63))


@njit("UniTuple(float64, 3)(float64[:, ::1])", cache=True, nogil=True)
def _spectrum(m):
    """Eigenvalues, descending, of a 3x3 matrix known to have real ones at or above 0 (rounding below 0 is cut).

    Roots of the characteristic polynomial by Viete's formula for three real roots.
    """
    mean = (m[0, 0] + m[1, 1] + m[2, 2]) / 3.0
    minors = (
        m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0] + m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]
        + m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    )  # fmt: skip
    determinant = (
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )
    p = mean * mean - minors / 3.0
    if p <= 0.0:
        return (max(mean, 0.0), max(mean, 0.0), max(mean, 0.0))
    q = mean * mean * mean - 0.5 * mean * minors + 0.5 * determinant
    third = math.acos(min(1.0, max(-1.0, q / (p * math.sqrt(p))))) / 3.0
    reach = 2.0 * math.sqrt(p)
    first = mean + reach * math.cos(third)
    last = mean + reach * math.cos(third + 2.0 * math.pi / 3.0)
    return (max(first, 0.0), max(3.0 * mean - first - last, 0.0), max(last, 0.0))


@njit("uint64[:, ::1](float64[:, ::1], float64[:, ::1], int64[::1], int64[::1], float64)", cache=True, nogil=True)
def _length_consistent(source, target, source_index, target_index, bound):
    count = len(source)
    adjacency = np.zeros((count, (count + 63) // 64), np.uint64)
    for i in range(count):
        for j in range(i + 1, count):
            if source_index[i] == source_index[j] or target_index[i] == target_index[j]:
                continue
            a = math.sqrt(
                (source[i, 0] - source[j, 0]) ** 2
                + (source[i, 1] - source[j, 1]) ** 2
                + (source[i, 2] - source[j, 2]) ** 2
            )
            b = math.sqrt(
                (target[i, 0] - target[j, 0]) ** 2
                + (target[i, 1] - target[j, 1]) ** 2
                + (target[i, 2] - target[j, 2]) ** 2
            )
            if abs(a - b) <= bound:
                _join(adjacency, i, j)
    return adjacency


@njit("void(uint64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64)", cache=True, nogil=True)
def _keep_similar_spectra(adjacency, source_covariances, target_covariances, bound):
    """Drops the edges whose summed covariances have unlike eigenvalues on the two sides."""
    for i in range(len(adjacency)):
        for j in range(i + 1, len(adjacency)):
            if _joined(adjacency, i, j):
                a = _spectrum(source_covariances[i] + source_covariances[j])
                b = _spectrum(target_covariances[i] + target_covariances[j])
                difference = 0.0
                for k in range(3):
                    difference += (math.sqrt(a[k]) - math.sqrt(b[k])) ** 2
                if not difference <= bound:
                    _part(adjacency, i, j)


@njit("void(uint64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64)", cache=True, nogil=True)
def _keep_similar_shapes(adjacency, source_covariances, target_covariances, bound):
    """Drops the edges whose summed covariances, taken as if in one frame, are far apart in Wasserstein distance."""
    for i in range(len(adjacency)):
        for j in range(i + 1, len(adjacency)):
            if _joined(adjacency, i, j):
                a = source_covariances[i] + source_covariances[j]
                b = target_covariances[i] + target_covariances[j]
                product = _spectrum(a @ b)  # has the eigenvalues of a^1/2 b a^1/2
                difference = a[0, 0] + a[1, 1] + a[2, 2] + b[0, 0] + b[1, 1] + b[2, 2]
                for k in range(3):
                    difference -= 2.0 * math.sqrt(product[k])
                if not difference <= bound:
                    _part(adjacency, i, j)
