"""Gauss-Newton over matched centroids and planes: the numerics of `gaussians`, whose header defines the cost.

A perturbation T exp([phi; rho]) moves the point a of the source by R (phi x a + rho). All quantities are in the frame
of the source, where the error R^T (b - t) - a of a pair a, b then decreases by phi x a + rho.
"""

import math

import numpy as np

from segslam.core.kernels import kernel

GATE = 11.345
"""0.99 quantile of chi-square with 3 degrees of freedom."""
CENTROID_NOISE_M = 0.07
"""Measured (simulated truth): noise of a centroid in each direction (m)."""
CENTROID_NOISE_SHARE = 0.35
"""Measured (simulated truth): additional noise of a centroid, as a share of its cluster's standard deviation."""
GROUND_NOISE_M = 0.1
"""Chosen: noise of the distance between two ground patches (m)."""
GROUND_WEIGHT = 0.3
"""Chosen: weight of such a distance; below 1 because the errors of neighbours are correlated."""
GROUND_SLOPE = 0.04
"""Chosen: noise of a plane's height at 1 m from the middle of its patch (m)."""
MAX_STEPS = 10
STEP_DONE = 1e-6
"""Chosen: the search stops after a step smaller than this (rad, m)."""


@kernel("void(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1])")
def _weight_matrix(source_covariance, target_covariance, R, W):
    """Writes the inverse covariance of the difference of two centroids, in the source frame. R: R_target_source.

    R may be a transform, of which only the rotation is used.
    """
    for row in range(3):
        for column in range(row + 1):
            extent = source_covariance[row, column]
            for u in range(3):
                for v in range(3):
                    extent += R[u, row] * target_covariance[u, v] * R[v, column]
            noise = 2.0 * CENTROID_NOISE_M * CENTROID_NOISE_M if row == column else 0.0
            W[row, column] = CENTROID_NOISE_SHARE * CENTROID_NOISE_SHARE * extent + noise
    xx, yy, zz, xy, xz, yz = W[0, 0], W[1, 1], W[2, 2], W[1, 0], W[2, 0], W[2, 1]
    W[0, 0], W[1, 1], W[2, 2] = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    W[0, 1], W[0, 2], W[1, 2] = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    determinant = xx * W[0, 0] + xy * W[0, 1] + xz * W[0, 2]
    for row in range(3):
        for column in range(row, 3):
            W[row, column] /= determinant
            W[column, row] = W[row, column]


@kernel("void(float64[:, ::1], float64[::1], float64[::1])")
def _to_source(T_target_source, point, out):
    """Writes R^T (point - t)."""
    T = T_target_source
    x, y, z = point[0] - T[0, 3], point[1] - T[1, 3], point[2] - T[2, 3]
    for k in range(3):
        out[k] = T[0, k] * x + T[1, k] * y + T[2, k] * z


@kernel("float64(float64[:, ::1], float64[::1])")
def _squared(W, e):
    """e^T W e."""
    total = 0.0
    for u in range(3):
        for v in range(3):
            total += e[u] * W[u, v] * e[v]
    return total


@kernel("float64[::1](float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[:, ::1])")
def squared_distances(source, target, source_covariances, target_covariances, T_target_source):
    """Squared Mahalanobis distance of matched centroids; infinite if it certainly exceeds the gate."""
    squared = np.full(len(source), np.inf)
    W, e = np.empty((3, 3)), np.empty(3)
    for i in range(len(source)):
        _to_source(T_target_source, target[i], e)
        length, extent = 0.0, 0.0
        for k in range(3):
            e[k] -= source[i, k]
            length += e[k] * e[k]
            extent += source_covariances[i, k, k] + target_covariances[i, k, k]
        trace = 6.0 * CENTROID_NOISE_M * CENTROID_NOISE_M + CENTROID_NOISE_SHARE * CENTROID_NOISE_SHARE * extent
        if length <= GATE * trace:  # the trace bounds every variance
            _weight_matrix(source_covariances[i], target_covariances[i], T_target_source, W)
            squared[i] = _squared(W, e)
    return squared


@kernel("void(float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64[::1])")
def _add_centroid(H, g, a, W, e):
    """Three rows of the normal equations: the centroid at `a` has the error `e`; Cauchy weight times `W`."""
    weight = 1.0 / (1.0 + _squared(W, e) / 3.0)
    J = np.zeros((3, 6))
    J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = a[2], -a[1], -a[2], a[0], a[1], -a[0]
    J[0, 3] = J[1, 4] = J[2, 5] = 1.0
    for r in range(6):
        for u in range(3):
            for v in range(3):
                lever = weight * J[u, r] * W[u, v]
                g[r] += lever * e[v]
                for c in range(6):
                    H[r, c] += lever * J[v, c]


@kernel("void(float64[:, ::1], float64[::1], float64[::1], float64[::1], float64, float64[::1])")
def _add_plane(H, g, lever, normal, gap, other):
    """One row of the normal equations: a point at `lever` is `gap` below a plane; `other` is what it is compared with.

    The Cauchy weight divided by the variance of a distance from a plane is weight / (sigma^2 + gap^2).
    """
    away = (lever[0] - other[0]) ** 2 + (lever[1] - other[1]) ** 2 + (lever[2] - other[2]) ** 2
    weight = GROUND_WEIGHT / (GROUND_NOISE_M * GROUND_NOISE_M + GROUND_SLOPE * GROUND_SLOPE * away + gap * gap)
    row = np.empty(6)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        row[k] = lever[i] * normal[j] - lever[j] * normal[i]
        row[3 + k] = normal[k]
    for r in range(6):
        g[r] += weight * gap * row[r]
        for c in range(6):
            H[r, c] += weight * row[r] * row[c]


@kernel("void(float64[:, ::1], float64[::1])")
def _solve(H, g):
    """Writes (H + 1e-9 I)^-1 g to g, by Cholesky decomposition; the caller must check H for singularity."""
    root = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            entry = H[i, j] + (1e-9 if i == j else 0.0)
            for k in range(j):
                entry -= root[i, k] * root[j, k]
            root[i, j] = math.sqrt(max(entry, 1e-9)) if i == j else entry / root[j, j]
    for i in range(6):
        for k in range(i):
            g[i] -= root[i, k] * g[k]
        g[i] /= root[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            g[i] -= root[k, i] * g[k]
        g[i] /= root[i, i]


@kernel("void(float64[:, ::1], float64[::1])")
def _move(T, step):
    """Writes T moved by the step [phi; rho]: t + R rho, and R rotated by phi with Rodrigues' formula."""
    x, y, z = step[0], step[1], step[2]
    angle = math.sqrt(x * x + y * y + z * z)
    a = math.sin(angle) / angle if angle > 1e-8 else 1.0
    b = (1.0 - math.cos(angle)) / (angle * angle) if angle > 1e-8 else 0.0
    for k in range(3):
        u, v, w = T[k, 0], T[k, 1], T[k, 2]
        p, q, r = v * z - w * y, w * x - u * z, u * y - v * x  # the row, times the matrix of the cross product
        T[k, 0] = u + a * p + b * (q * z - r * y)
        T[k, 1] = v + a * q + b * (r * x - p * z)
        T[k, 2] = w + a * r + b * (p * y - q * x)
        T[k, 3] += u * step[3] + v * step[4] + w * step[5]


@kernel(
    "Tuple((float64[:, ::1], float64[:, ::1]))(float64[:, ::1], float64[:, ::1], float64[:, :, ::1],"
    "float64[:, :, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1],"
    "float64[:, ::1], float64[:, ::1])"
)
def least_cost(
    source, target, source_covariances, target_covariances, source_patches, target_planes, target_normals,
    target_patches, source_planes, source_normals, T_target_source,
):  # fmt: skip
    """Gauss-Newton with Cauchy weights until convergence; returns the pose and the last J^T W J."""
    T = T_target_source.copy()
    H, g = np.zeros((6, 6)), np.zeros(6)
    W, e, normal, point = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for _ in range(MAX_STEPS):
        H[:], g[:] = 0.0, 0.0
        for i in range(len(source)):
            _to_source(T, target[i], e)
            for k in range(3):
                e[k] -= source[i, k]
            _weight_matrix(source_covariances[i], target_covariances[i], T, W)
            _add_centroid(H, g, source[i], W, e)
        for i in range(len(source_patches)):
            _to_source(T, target_planes[i], point)
            gap = 0.0
            for k in range(3):
                normal[k] = 0.0
                for u in range(3):
                    normal[k] += T[u, k] * target_normals[i, u]
                gap += normal[k] * (point[k] - source_patches[i, k])
            _add_plane(H, g, source_patches[i], normal, gap, point)
        for i in range(len(target_patches)):
            _to_source(T, target_patches[i], point)
            gap = 0.0
            for k in range(3):
                gap += source_normals[i, k] * (point[k] - source_planes[i, k])
            _add_plane(H, g, point, source_normals[i], gap, source_planes[i])
        _solve(H, g)
        _move(T, g)
        largest = 0.0
        for k in range(6):
            largest = max(largest, abs(g[k]))
        if largest < STEP_DONE:
            break
    return T, H
