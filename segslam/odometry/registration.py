"""A scan aligned with the local map: the registration of KISS-ICP (Vizzo et al., RA-L 2023, Section III-D).

Each point of the source meets its nearest neighbour in the map, if that is near enough; a Gauss-Newton step brings the
pairs together under the Geman-McClure kernel; and so on until the step is short. All of it in KISS-ICP's order and in
float64, so that the poses are those of KISS-ICP to rounding; unlike its own, the sums repeat to the bit.
"""

import math

import numpy as np
from numba import njit

from segslam import geometry
from segslam.odometry.local_map import EMPTY, LocalMap, nearest
from segslam.types import Points, Transform

TINY = np.finfo(np.float64).tiny
"""Of a pivot: below it no pair says anything of its direction."""


class Registration:
    """Stands in for KISS-ICP's own."""

    def __init__(self, *, max_iterations: int, convergence: float) -> None:
        """It ends with a step, [translation m; rotation rad] about the map's origin, shorter than `convergence`."""
        self._max_iterations = max_iterations
        self._convergence = convergence

    def align_points_to_map(
        self,
        points: Points,
        voxel_map: LocalMap,
        initial_guess: Transform,
        max_correspondance_distance: float,
        kernel: float,
    ) -> Transform:
        """T_odom_lidar of the points, near the guess; the guess where the map is empty. Named as KISS-ICP calls it."""
        if voxel_map.num_voxels == 0:
            return initial_guess
        axes, origin = _align(
            voxel_map.voxels,
            voxel_map.voxel_m,
            geometry.apply(initial_guess, points),
            max_correspondance_distance**2,
            kernel,
            self._convergence,
            self._max_iterations,
        )
        return geometry.transform(axes.T, origin) @ initial_guess


@njit(cache=True, nogil=True)
def _align(voxels, voxel_m, source, squared_bound, kernel, convergence, max_iterations):
    """Where the axes, a row each, and the origin go in the motion that brings the source onto the map.

    The source, points in the map's frame, moves along.
    """
    axes, origin = np.eye(3), np.zeros((1, 3))
    R, t = np.empty((3, 3)), np.empty(3)
    for _ in range(max_iterations):
        step = _solution(_normal_equations(voxels, voxel_m, source, squared_bound, kernel))
        _screw(step, R, t)
        _move(axes, R, np.zeros(3))
        _move(origin, R, t)
        _move(source, R, t)
        if _length(step) < convergence:
            break
    return axes, origin[0]


@njit(cache=True, nogil=True)
def _normal_equations(voxels, voxel_m, source, squared_bound, kernel):
    """[H | g] (6, 7) of the step [translation; rotation], the perturbation on the left: H step = -g.

    Of a pair with the weight w, J = [I, -point x] and r = point - met, it has w J^T J, upper half, and w J^T r.
    """
    S = np.zeros((6, 7))
    for i in range(len(source)):
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        row, place, squared = nearest(voxels, voxel_m, x, y, z, squared_bound)
        if row == EMPTY:
            continue
        weight = (kernel / (kernel + squared)) ** 2
        u = weight * (x - voxels.points[row, place, 0])
        v = weight * (y - voxels.points[row, place, 1])
        w = weight * (z - voxels.points[row, place, 2])
        wx, wy, wz = weight * x, weight * y, weight * z
        S[0, 0] += weight
        S[0, 4] += wz
        S[0, 5] -= wy
        S[1, 5] += wx
        S[3, 3] += wy * y + wz * z
        S[3, 4] -= wx * y
        S[3, 5] -= wx * z
        S[4, 4] += wx * x + wz * z
        S[4, 5] -= wy * z
        S[5, 5] += wx * x + wy * y
        S[0, 6] += u
        S[1, 6] += v
        S[2, 6] += w
        S[3, 6] += y * w - z * v
        S[4, 6] += z * u - x * w
        S[5, 6] += x * v - y * u
    S[1, 1] = S[2, 2] = S[0, 0]
    S[1, 3], S[2, 3], S[2, 4] = -S[0, 4], -S[0, 5], -S[1, 5]
    return S


@njit("float64[::1](float64[:, ::1])", cache=True, nogil=True)
def _solution(S):
    """x of H x = -g, from the upper half of H beside g, H symmetric and not negative: by H = L D L^T.

    0 in directions that no pair says anything of.
    """
    x = np.zeros(6)
    for k in range(6):
        if S[k, k] <= TINY:
            continue
        for row in range(k + 1, 6):
            share = S[k, row] / S[k, k]
            for column in range(row, 7):
                S[row, column] -= share * S[k, column]
    for k in range(5, -1, -1):
        if S[k, k] > TINY:
            x[k] = -S[k, 6]
            for column in range(k + 1, 6):
                x[k] -= S[k, column] * x[column]
            x[k] /= S[k, k]
    return x


@njit("void(float64[::1], float64[:, ::1], float64[::1])", cache=True, nogil=True)
def _screw(step, R, t):
    """Write R and t of the motion along [translation; rotation]: `geometry.exp`, its halves the other way round."""
    u, v, w, x, y, z = step[0], step[1], step[2], step[3], step[4], step[5]
    squared = x * x + y * y + z * z
    theta = math.sqrt(squared)
    if theta > 1e-4:
        a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / squared
        c = (1.0 - a) / squared
    else:  # their limits: the closed forms lose digits here
        a, b, c = 1.0, 0.5, 1.0 / 6.0
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    along, rest = c * (x * u + y * v + z * w), 1.0 - c * squared
    t[0] = rest * u + b * (y * w - z * v) + along * x
    t[1] = rest * v + b * (z * u - x * w) + along * y
    t[2] = rest * w + b * (x * v - y * u) + along * z


@njit("void(float64[:, ::1], float64[:, ::1], float64[::1])", cache=True, nogil=True)
def _move(points, R, t):
    """Each point to R point + t, in place."""
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for axis in range(3):
            points[i, axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2] * z + t[axis]


@njit("float64(float64[::1])", cache=True, nogil=True)
def _length(vector):
    squared = 0.0
    for value in vector:
        squared += value * value
    return math.sqrt(squared)
