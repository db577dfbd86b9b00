"""G-TRIM: the graph whose edges join pairs of correspondences that are consistent with one rigid motion.

Yin et al., "Segregator", ICRA 2023, section III-C. For correspondences i, j between source Gaussians a and target
Gaussians b, the translation- and rotation-invariant measurement of each side is N(mu_i - mu_j, Sigma_i + Sigma_j).

| here | paper |
|---|---|
| length test | abs(abs(mu_a) - abs(mu_b)) <= beta, the l-TRIM of TEASER (Yang, Shi, Carlone, T-RO 2021) |
| published gate | tr(Sa + Sb - 2 (Sa^1/2 Sb Sa^1/2)^1/2) <= bound, the shape term of the squared Wasserstein distance |
| invariant gate | sum_k (sqrt(lambda_k(Sa)) - sqrt(lambda_k(Sb)))^2 <= bound, its minimum over all rotations |

Differs from the paper: its mean term compares vectors of two frames; the length test replaces it, as in the authors'
program. Correspondences that share an end are never joined, because an object cannot be in two places.
"""

import math

import numpy as np

from segslam.core.config import SegregatorConfig
from segslam.core.kernels import kernel
from segslam.registration.cliques import Bits, lowest_bit, members
from segslam.registration.segregator.correspondences import Correspondences


def consistency_graph(correspondences: Correspondences, *, length_bound_m: float, config: SegregatorConfig) -> Bits:
    """The graph from the length test (l-TRIM) and the gate `config.gate`, with a vertex for each correspondence."""
    adjacency = _length_consistent(
        correspondences.source,
        correspondences.target,
        correspondences.source_index,
        correspondences.target_index,
        length_bound_m,
    )
    if config.gate != "lengths":
        covariances = correspondences.source_covariances, correspondences.target_covariances
        _part_shapes(adjacency, *covariances, config.gate == "invariant", config.shape_bound_m2)
    return adjacency


@kernel("uint64[:, ::1](float64[:, ::1], float64[:, ::1], int64[::1], int64[::1], float64)")
def _length_consistent(source, target, source_index, target_index, bound):
    """Bits of the pairs with abs(a - b) <= bound for their lengths a, b, and with four distinct ends.

    The test is (a^2 + b^2 - bound^2)^2 <= 4 a^2 b^2, which needs no square root. A row is tested starting with the word
    that contains its own bit, in one loop over slices that start at 0, which the compiler vectorises.
    """
    count = len(source)
    words = (count + 63) // 64
    adjacency = np.zeros((count, words), np.uint64)
    source_x, source_y, source_z = source[:, 0].copy(), source[:, 1].copy(), source[:, 2].copy()
    target_x, target_y, target_z = target[:, 0].copy(), target[:, 1].copy(), target[:, 2].copy()
    flags = np.zeros(64 * words, np.uint8)
    eights = flags.view(np.uint64)
    for i in range(count):
        first = i & ~63
        ax, ay, az, p = source_x[first:], source_y[first:], source_z[first:], source_index[first:]
        bx, by, bz, q = target_x[first:], target_y[first:], target_z[first:], target_index[first:]
        x, y, z, own_p = source_x[i], source_y[i], source_z[i], source_index[i]
        u, v, w, own_q = target_x[i], target_y[i], target_z[i], target_index[i]
        row = flags[first:]
        for j in range(len(ax)):
            a = (ax[j] - x) ** 2 + (ay[j] - y) ** 2 + (az[j] - z) ** 2
            b = (bx[j] - u) ** 2 + (by[j] - v) ** 2 + (bz[j] - w) ** 2
            excess = a + b - bound * bound
            row[j] = ((excess <= 0.0) | (excess * excess <= 4.0 * a * b)) & (p[j] != own_p) & (q[j] != own_q)
        for word in range(i >> 6, words):
            bits = np.uint64(0)
            for k in range(8):  # from 64 bytes of 0 or 1: a product collects eight lowest bits in its highest byte
                eight = eights[8 * word + k] * np.uint64(0x0102040810204080)
                bits |= (eight >> np.uint64(56)) << np.uint64(8 * k)
            adjacency[i, word] |= bits
            while bits and word > i >> 6:  # the word that contains bit i was tested for both orders
                adjacency[64 * word + lowest_bit(bits), i >> 6] |= np.uint64(1) << np.uint64(i & 63)
                bits &= bits - np.uint64(1)
    return adjacency


@kernel("float64(UniTuple(float64, 6), UniTuple(float64, 6))")
def _inner(a, b):
    """tr(A B) of symmetric matrices given as xx, yy, zz, xy, xz, yz."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + 2.0 * (a[3] * b[3] + a[4] * b[4] + a[5] * b[5])


@kernel("UniTuple(float64, 6)(UniTuple(float64, 6))")
def _adjugate(m):
    xx, yy, zz, xy, xz, yz = m
    return (
        yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy, xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    )  # fmt: skip


@kernel("UniTuple(float64, 6)(float64[:, :, ::1], int64, int64)")
def _sum(covariances, i, j):
    a, b = covariances[i], covariances[j]
    return (
        a[0, 0] + b[0, 0], a[1, 1] + b[1, 1], a[2, 2] + b[2, 2], a[0, 1] + b[0, 1], a[0, 2] + b[0, 2], a[1, 2] + b[1, 2]
    )  # fmt: skip


@kernel("UniTuple(float64, 3)(float64, float64, float64)")
def _root_eigenvalues(trace, minors, determinant):
    """Square roots, descending, of the eigenvalues of a 3x3 matrix with real, non-negative eigenvalues.

    Uses Viete's formula for the three real roots of the characteristic polynomial; negative rounding errors become 0.
    """
    mean = trace / 3.0
    p = max(mean * mean - minors / 3.0, 0.0)
    q = mean * mean * mean - 0.5 * mean * minors + 0.5 * determinant
    reach = math.sqrt(p)
    turn = math.acos(min(1.0, max(-1.0, q / (p * reach)))) / 3.0 if p > 0.0 else 0.0
    first = mean + 2.0 * reach * math.cos(turn)
    last = mean + 2.0 * reach * math.cos(turn + 2.0 * math.pi / 3.0)
    return (math.sqrt(first), math.sqrt(max(trace - first - last, 0.0)), math.sqrt(max(last, 0.0)))


@kernel("UniTuple(float64, 3)(UniTuple(float64, 6))")
def _roots(m):
    adjugate = _adjugate(m)
    return _root_eigenvalues(m[0] + m[1] + m[2], adjugate[0] + adjugate[1] + adjugate[2], _inner(m, adjugate) / 3.0)


@kernel("float64(UniTuple(float64, 6), UniTuple(float64, 6))")
def _spectral_distance(a, b):
    roots_a, roots_b = _roots(a), _roots(b)
    return (roots_a[0] - roots_b[0]) ** 2 + (roots_a[1] - roots_b[1]) ** 2 + (roots_a[2] - roots_b[2]) ** 2


@kernel("float64(UniTuple(float64, 6), UniTuple(float64, 6))")
def _shape_distance(a, b):
    """Shape term; a^1/2 b a^1/2 has the eigenvalues of a b, whose invariants follow from those of a and b."""
    adjugate_a, adjugate_b = _adjugate(a), _adjugate(b)
    determinant = _inner(a, adjugate_a) * _inner(b, adjugate_b) / 9.0
    roots = _root_eigenvalues(_inner(a, b), _inner(adjugate_a, adjugate_b), determinant)
    return a[0] + a[1] + a[2] + b[0] + b[1] + b[2] - 2.0 * (roots[0] + roots[1] + roots[2])


@kernel("void(uint64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], boolean, float64)")
def _part_shapes(adjacency, source_covariances, target_covariances, invariant, bound):
    """Removes the edges of pairs whose summed covariances in the two scans are not within the bound (m^2)."""
    neighbours = np.empty(len(adjacency), np.int64)
    for i in range(len(adjacency)):
        for k in range(members(adjacency[i], neighbours)):
            j = neighbours[k]
            if j > i:
                a, b = _sum(source_covariances, i, j), _sum(target_covariances, i, j)
                distance = _spectral_distance(a, b) if invariant else _shape_distance(a, b)
                if not distance <= bound:
                    adjacency[i, j >> 6] &= ~(np.uint64(1) << np.uint64(j & 63))
                    adjacency[j, i >> 6] &= ~(np.uint64(1) << np.uint64(i & 63))
