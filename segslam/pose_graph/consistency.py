"""Closures that agree with each other: the largest set of which every two close a loop within their noise.

Mangelson, Dominic, Eustice, Vasudevan, "Pairwise Consistent Measurement Set Maximization for Robust Multi-robot Map
Merging", ICRA 2018. Two closures and the odometry between their sources and between their targets make a loop; its
error is weighed by what the noise of these four says.

| symbol | here |
|---|---|
| z_ik, z_jl | `T_target_source` of two closures |
| x_ij, x_lk | odometry between the targets, between the sources |
| gamma | `bound` |

A closure moves its source by C = T_odom_target T_target_source inverse(T_odom_source): what drifted on the way. Two
closures agree if C_p inverse(C_q) is what may have drifted between them: all in one frame, so that the covariances
of any stretch of odometry are a difference of two sums. Differs from the paper: a motion within both stretches counts
once forth and once back and cancels, or twice; that the drift itself turns these covariances is left out.
"""

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numba import njit
from scipy.spatial import KDTree

from segslam.cliques import maximum_cliques, pack_rows
from segslam.pose_graph.edges import Edge, Transforms
from segslam.types import Indices, Mask, Vector

MOST_NODES = 20_000
"""Bound of the clique search: a second where 1,500 true closures almost all agree, and any large set of them serves."""
NO_AGREEMENT = 1e12
"""Chi-square of two closures that differ by half a turn, where it has no meaning."""
Matrices = Float[np.ndarray, "_ 6 6"]
Agreements = Bool[np.ndarray, "_ _"]


class Shifts(NamedTuple):
    """What each closure says has drifted, a row each, in one frame."""

    T_world_drifted: Transforms
    covariances: Matrices
    """Of the closures' own noise."""
    sources: Indices
    targets: Indices


def agreements(odometry: Sequence[Edge], closures: Sequence[Edge], bound: float) -> Agreements:
    """(k, k) which two closures have a chi-square, with 6 degrees of freedom, within `bound`.

    `odometry` leads from each vertex 0, 1, 2, ... to the next.
    """
    if not closures:
        return np.zeros((0, 0), dtype=bool)
    return pairwise_chi2(odometry, closures, enough=bound) <= bound


def largest_agreeing(agree: Agreements, among: Mask) -> Mask:
    """(k,) the largest set of closures among some of which every two agree."""
    chosen = np.zeros(len(among), dtype=bool)
    rows = np.flatnonzero(among)
    if len(rows):
        found = maximum_cliques(pack_rows(agree[np.ix_(rows, rows)]), max_cliques=1, max_nodes=MOST_NODES)
        chosen[rows[found.cliques[0]]] = True
    return chosen


def pairwise_chi2(
    odometry: Sequence[Edge], closures: Sequence[Edge], *, enough: float = math.inf
) -> Float[np.ndarray, "_ _"]:
    """(k, k) chi-square of the loop that each two closures make; above `enough` a lower bound of it, sooner known."""
    T_world = _chained(odometry)
    shifts = _shifts(T_world, closures)
    summed = np.cumsum(np.concatenate([np.zeros((1, 6, 6)), _carried(T_world[1:], odometry)]), axis=0)
    chi2 = np.zeros((len(closures), len(closures)))
    _fill(
        shifts.T_world_drifted,
        np.linalg.inv(shifts.T_world_drifted),
        shifts.covariances,
        summed,
        shifts.sources,
        shifts.targets,
        enough,
        chi2,
    )
    return chi2


def ends_m(closures: Sequence[Edge], travel_m: Vector) -> Float[np.ndarray, "_ 2"]:
    """(k, 2) m of travel to the two ends of each closure."""
    return travel_m[np.array([(edge.a, edge.b) for edge in closures], dtype=np.int64).reshape(-1, 2)]


def neighbours(ends_m: Float[np.ndarray, "k 2"], within_m: float) -> Agreements:
    """(k, k) which two closures join the same two places: both ends within so much travel, as are its own."""
    first, second = (np.abs(column[:, None] - column) <= within_m for column in ends_m.T)
    return first & second


def num_near(ends_m: Float[np.ndarray, "k 2"], within_m: float) -> Indices:
    """(k,) how many closures join the same two places as each, itself among them: the row sums of `neighbours`."""
    return KDTree(ends_m).query_ball_point(ends_m, within_m, p=np.inf, return_length=True)


def adjoints(T_a_b: Transforms) -> Matrices:
    """Each maps tangents of b to those of a."""
    x, y, z = T_a_b[:, :3, 3].T
    nothing = np.zeros_like(x)
    cross = np.array([[nothing, -z, y], [z, nothing, -x], [-y, x, nothing]]).transpose(2, 0, 1)
    whole = np.zeros((len(T_a_b), 6, 6))
    whole[:, :3, :3] = whole[:, 3:, 3:] = T_a_b[:, :3, :3]
    whole[:, 3:, :3] = cross @ T_a_b[:, :3, :3]
    return whole


def _chained(odometry: Sequence[Edge]) -> Transforms:
    """(n, 4, 4) poses along odometry; the world's origin is in their middle, where sums round least."""
    T_world = np.array(list(accumulate((edge.T_a_b for edge in odometry), np.matmul, initial=np.eye(4))))
    T_world[:, :3, 3] -= T_world[:, :3, 3].mean(axis=0)
    return T_world


def _shifts(T_world: Transforms, closures: Sequence[Edge]) -> Shifts:
    targets, sources = (np.array([(edge.a, edge.b) for edge in closures])).T.copy()
    T_world_moved = T_world[targets] @ np.array([edge.T_a_b for edge in closures])
    return Shifts(T_world_moved @ np.linalg.inv(T_world[sources]), _carried(T_world_moved, closures), sources, targets)


def _carried(T_world_end: Transforms, edges: Sequence[Edge]) -> Matrices:
    """The covariances of edges in the world, each where its far end is."""
    turns = adjoints(T_world_end)
    return turns @ np.linalg.inv(np.array([edge.information for edge in edges])) @ turns.transpose(0, 2, 1)


@njit("boolean(float64[:, ::1], float64[:, ::1], float64[::1])", cache=True, nogil=True)
def _log_of_product(T_a_b, T_b_c, tangent):
    """Writes log(T_a_b T_b_c); false for a turn so near a half one that the axis is lost."""
    R, t = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        for j in range(3):
            R[i, j] = T_a_b[i, 0] * T_b_c[0, j] + T_a_b[i, 1] * T_b_c[1, j] + T_a_b[i, 2] * T_b_c[2, j]
        t[i] = T_a_b[i, 0] * T_b_c[0, 3] + T_a_b[i, 1] * T_b_c[1, 3] + T_a_b[i, 2] * T_b_c[2, 3] + T_a_b[i, 3]
    x, y, z = (R[2, 1] - R[1, 2]) / 2.0, (R[0, 2] - R[2, 0]) / 2.0, (R[1, 0] - R[0, 1]) / 2.0
    cosine = (R[0, 0] + R[1, 1] + R[2, 2] - 1.0) / 2.0
    sine = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, cosine)
    if cosine < -0.99:
        return False
    small = angle < 1e-4  # the next terms of the series are below 1e-9
    scale = 1.0 + angle * angle / 6.0 if small else angle / sine
    x, y, z = x * scale, y * scale, z * scale
    bend = 1.0 / 12.0 if small else (1.0 - angle * sine / (2.0 * (1.0 - cosine))) / (angle * angle)
    u, v, w = y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0]
    tangent[0], tangent[1], tangent[2] = x, y, z
    tangent[3] = t[0] - u / 2.0 + bend * (y * w - z * v)
    tangent[4] = t[1] - v / 2.0 + bend * (z * u - x * w)
    tangent[5] = t[2] - w / 2.0 + bend * (x * v - y * u)
    return True


@njit(
    "void(float64[:, :, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[:, :, ::1], int64[::1], int64[::1],"
    "float64, float64[:, ::1])",
    cache=True,
    nogil=True,
)
def _fill(T_world_drifted, T_drifted_world, own, summed, sources, targets, enough, chi2):
    """Writes the chi-square of each two closures, by Cholesky's root of the covariance of their loop."""
    error, root = np.empty(6), np.empty((6, 6))
    for p in range(len(sources)):
        for q in range(p):
            chi2[p, q] = chi2[q, p] = NO_AGREEMENT
            if not _log_of_product(T_world_drifted[p], T_drifted_world[q], error):
                continue
            s0, s1 = min(sources[p], sources[q]), max(sources[p], sources[q])
            t0, t1 = min(targets[p], targets[q]), max(targets[p], targets[q])
            both0 = max(s0, t0)
            both1 = max(min(s1, t1), both0)
            same_way = (sources[q] > sources[p]) == (targets[q] > targets[p])
            twice = -2.0 if same_way else 2.0  # (1 - 1)^2 or (1 + 1)^2 in place of 1 + 1
            total = 0.0
            for i in range(6):
                for j in range(i + 1):
                    entry = own[p, i, j] + own[q, i, j] + summed[s1, i, j] - summed[s0, i, j]
                    entry += summed[t1, i, j] - summed[t0, i, j] + twice * (summed[both1, i, j] - summed[both0, i, j])
                    for k in range(j):
                        entry -= root[i, k] * root[j, k]
                    root[i, j] = math.sqrt(entry) if i == j else entry / root[j, j]
                for k in range(i):
                    error[i] -= root[i, k] * error[k]
                error[i] /= root[i, i]
                total += error[i] * error[i]
                if total > enough:
                    break
            chi2[p, q] = chi2[q, p] = total
