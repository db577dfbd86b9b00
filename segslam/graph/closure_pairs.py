"""Pairwise-consistent closures: the largest set in which every pair is consistent within its noise.

Mangelson, Dominic, Eustice, Vasudevan, "Pairwise Consistent Measurement Set Maximization for Robust Multi-robot Map
Merging", ICRA 2018. Two closures and the odometry between their sources and between their targets make a loop; its
error is whitened by the noise of these four.

| symbol | here |
|---|---|
| z_ik, z_jl | `T_target_source` of two closures |
| x_ij, x_lk | odometry between the targets, between the sources |
| gamma | `bound` |

A closure moves its source by C = T_odom_target T_target_source inverse(T_odom_source), the drift on the way. Two
closures are consistent if C_p inverse(C_q) is within the noise of the drift between them. All are in one frame, so the
covariance of any stretch of odometry is a difference of two sums, transformed by C_p between the sources. Differs from
the paper: odometry shared by both stretches cancels if both are driven the same way, and counts twice otherwise.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core.kernels import kernel
from segslam.core.trajectory import Poses
from segslam.core.types import Indices, Mask, Vector
from segslam.graph.edges import Edge, chained
from segslam.registration.cliques import maximum_cliques, pack_rows

MAX_PAIRED = 5_000
"""Largest number of closures compared pairwise (10 s, 450 MB); for more, graduated non-convexity selects."""
MOST_NODES = 20_000
"""Bound of the clique search: a second where 1,500 true closures are almost all consistent; any large set of them will
do."""
Matrices = Float[np.ndarray, "_ 6 6"]
Pairs = Bool[np.ndarray, "_ _"]


def consistent_pairs(odometry: Sequence[Edge], closures: Sequence[Edge], bound: float) -> Pairs:
    """(k, k) which two closures have a chi-square, with 6 degrees of freedom, within `bound`.

    `odometry` leads from each vertex 0, 1, 2, ... to the next.
    """
    if not closures:
        return np.zeros((0, 0), dtype=bool)
    return pairwise_chi2(odometry, closures, enough=bound) <= bound


def largest_consistent(consistent: Pairs, among: Mask | None = None) -> Mask:
    """(k,) the largest pairwise-consistent set among some closures, by default all."""
    rows = np.arange(len(consistent)) if among is None else np.flatnonzero(among)
    chosen = np.zeros(len(consistent), dtype=bool)
    if len(rows):
        (clique,) = maximum_cliques(pack_rows(consistent[np.ix_(rows, rows)]), max_cliques=1, max_nodes=MOST_NODES)
        chosen[rows[clique]] = True
    return chosen


def pairwise_chi2(
    odometry: Sequence[Edge], closures: Sequence[Edge], *, enough: float = math.inf
) -> Float[np.ndarray, "_ _"]:
    """(k, k) chi-square of the loop that two closures make; above `enough`, a lower bound of it, which is faster."""
    T_world = chained(odometry)
    T_world[:, :3, 3] -= T_world[:, :3, 3].mean(axis=0)  # an origin amid the poses limits rounding errors
    targets, sources = np.array([(edge.a, edge.b) for edge in closures]).T.copy()
    T_world_moved = T_world[targets] @ np.array([edge.T_a_b for edge in closures])
    T_world_drifted = T_world_moved @ np.linalg.inv(T_world[sources])  # the drift that each closure measures
    own = carried(T_world_moved, closures)
    summed = np.cumsum(np.concatenate([np.zeros((1, 6, 6)), carried(T_world[1:], odometry)]), axis=0)
    chi2 = np.zeros((len(closures), len(closures)))
    inverses, turns = np.linalg.inv(T_world_drifted), adjoints(T_world_drifted)
    rotations = ScipyRotation.from_matrix(T_world_drifted[:, :3, :3])
    quaternions = rotations.as_quat(), rotations.inv().as_quat()
    _fill(T_world_drifted, inverses, *quaternions, turns, own, summed, sources, targets, enough, chi2)
    return chi2


def neighbours(closures: Sequence[Edge], travel_m: Vector, within_m: float) -> Pairs:
    """(k, k) which two closures join the same two places: both ends within so much travel, as are its own."""
    ends_m = _ends_m(closures, travel_m)
    return cdist(ends_m, ends_m, "chebyshev") <= within_m


def num_near(closures: Sequence[Edge], travel_m: Vector, within_m: float) -> Indices:
    """(k,) how many closures join the same two places as each, itself among them: the row sums of `neighbours`."""
    ends_m = _ends_m(closures, travel_m)
    return KDTree(ends_m).query_ball_point(ends_m, within_m, p=np.inf, return_length=True)


def _ends_m(closures: Sequence[Edge], travel_m: Vector) -> Float[np.ndarray, "_ 2"]:
    return travel_m[np.array([(edge.a, edge.b) for edge in closures], dtype=np.int64).reshape(-1, 2)]


def adjoints(T_a_b: Poses) -> Matrices:
    """(k, 6, 6) adjoint matrices, which map tangents of b to tangents of a."""
    whole = np.zeros((len(T_a_b), 6, 6))
    whole[:, :3, :3] = whole[:, 3:, 3:] = T_a_b[:, :3, :3]
    whole[:, 3:, :3] = np.cross(T_a_b[:, :3, 3, None], T_a_b[:, :3, :3], axis=1)
    return whole


def carried(T_world_end: Poses, edges: Sequence[Edge]) -> Matrices:
    """Covariances of edges in the world frame, at their second vertices."""
    turns = adjoints(T_world_end)
    information = np.array([edge.information for edge in edges]).reshape(-1, 6, 6)
    return turns @ np.linalg.inv(information) @ turns.transpose(0, 2, 1)


@kernel("void(float64[:, ::1], float64[::1], float64[:, ::1], float64[::1], float64[::1])")
def _log_of_product(T_a_b, turn_a_b, T_b_c, turn_b_c, tangent):
    """Writes log(T_a_b T_b_c); `turn`: the quaternions (x, y, z, w) of the rotations. Exact up to half a turn."""
    t = np.empty(3)
    for i in range(3):
        t[i] = T_a_b[i, 0] * T_b_c[0, 3] + T_a_b[i, 1] * T_b_c[1, 3] + T_a_b[i, 2] * T_b_c[2, 3] + T_a_b[i, 3]
    a, b, c, d = turn_a_b
    e, f, g, h = turn_b_c
    x, y, z = d * e + h * a + b * g - c * f, d * f + h * b + c * e - a * g, d * g + h * c + a * f - b * e
    w = d * h - a * e - b * f - c * g
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    length = math.sqrt(x * x + y * y + z * z)
    angle = 2.0 * math.atan2(length, w)
    small = angle < 1e-4  # the next terms of the series are below 1e-9
    scale = 2.0 / w if small else angle / length
    x, y, z = x * scale, y * scale, z * scale
    # half / tan(half) = half * w / length, half of the angle
    bend = 1.0 / 12.0 if small else (1.0 - 0.5 * angle * w / length) / (angle * angle)
    u, v, w = y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0]
    tangent[0], tangent[1], tangent[2] = x, y, z
    tangent[3] = t[0] - u / 2.0 + bend * (y * w - z * v)
    tangent[4] = t[1] - v / 2.0 + bend * (z * u - x * w)
    tangent[5] = t[2] - w / 2.0 + bend * (x * v - y * u)


@kernel(
    "void(float64[:, :, ::1], float64[:, :, ::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1],"
    "float64[:, :, ::1], float64[:, :, ::1], int64[::1], int64[::1], float64, float64[:, ::1])"
)
def _fill(T_world_drifted, T_drifted_world, forwards, backwards, turns, own, summed, sources, targets, enough, chi2):
    """Writes the chi-square of each two closures, by Cholesky's root of the covariance of their loop."""
    error, root, turned = np.empty(6), np.empty((6, 6)), np.empty(6)
    for p in range(len(sources)):
        A = turns[p]
        for q in range(p):
            _log_of_product(T_world_drifted[p], forwards[p], T_drifted_world[q], backwards[q], error)
            s0, s1 = min(sources[p], sources[q]), max(sources[p], sources[q])
            t0, t1 = min(targets[p], targets[q]), max(targets[p], targets[q])
            both0 = max(s0, t0)
            both1 = max(min(s1, t1), both0)
            same_way = (sources[q] > sources[p]) == (targets[q] > targets[p])
            sign = -1.0 if same_way else 1.0
            total = 0.0
            for i in range(6):
                for m in range(6):
                    turned[m] = 0.0
                    for k in range(6):
                        turned[m] += A[i, k] * (summed[s1, k, m] - summed[s0, k, m])
                for j in range(i + 1):
                    entry = own[p, i, j] + own[q, i, j] + summed[t1, i, j] - summed[t0, i, j]
                    for k in range(6):
                        entry += turned[k] * A[j, k]
                    if both1 > both0:
                        for k in range(6):
                            entry += sign * A[i, k] * (summed[both1, k, j] - summed[both0, k, j])
                            entry += sign * A[j, k] * (summed[both1, i, k] - summed[both0, i, k])
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
