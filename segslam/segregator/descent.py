"""Gauss-Newton over matched centroids and planes: the numerics of `gaussians`, whose header has the cost.

A perturbation T exp([phi; rho]) moves the point a of the source by R (phi x a + rho). All is done in the frame of the
source, where the error R^T (b - t) - a of a pair a, b then falls by phi x a + rho.
"""

import numpy as np
from numba import njit

GATE = 11.345
"""0.99 quantile of chi-square with 3 degrees of freedom."""
GROUND_SLOPE = 0.04
"""Chosen: noise of a plane's height a metre away from the middle of its patch (m)."""
MAX_STEPS = 10
STEP_DONE = 1e-6
"""Chosen: rad or m, of the step after which no other is made."""


@njit("float64[::1, :](float64[:, ::1], float64[:, ::1], float64[:, ::1], float64, float64)", cache=True, nogil=True)
def _weight_matrix(source_covariance, target_covariance, R, noise, share):
    """Inverse covariance of the difference of two centroids, in the source's frame; R turns source to target."""
    covariance = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            extent = source_covariance[row, column]
            for u in range(3):
                for v in range(3):
                    extent += R[u, row] * target_covariance[u, v] * R[v, column]
            covariance[row, column] = share * share * extent + (2.0 * noise * noise if row == column else 0.0)
    return np.linalg.inv(covariance)


@njit("float64[::1](float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[:, ::1], float64,"
      "float64)", cache=True, nogil=True)  # fmt: skip
def squared_distances(source, target, source_covariances, target_covariances, T_target_source, noise, share):
    """Squared Mahalanobis distance of matched centroids; infinite where it is surely above the gate."""
    R, t = T_target_source[:3, :3].copy(), T_target_source[:3, 3].copy()
    squared = np.full(len(source), np.inf)
    for i in range(len(source)):
        e = (target[i] - t) @ R - source[i]
        extent = np.trace(source_covariances[i]) + np.trace(target_covariances[i])
        if e @ e <= GATE * (6.0 * noise * noise + share * share * extent):  # no variance is above the trace
            squared[i] = e @ _weight_matrix(source_covariances[i], target_covariances[i], R, noise, share) @ e
    return squared


@njit("void(float64[:, ::1], float64[::1], float64[::1], float64[::1], float64, float64)", cache=True, nogil=True)
def _add_plane(H, g, lever, normal, gap, weight):
    """One row of the normal equations: a point at `lever` is `gap` below a plane."""
    row = np.empty(6)
    row[:3] = np.cross(lever, normal)
    row[3:] = normal
    for r in range(6):
        g[r] += weight * gap * row[r]
        for c in range(6):
            H[r, c] += weight * row[r] * row[c]


@njit("float64(float64, float64[::1], float64[::1], float64, float64)", cache=True, nogil=True)
def _plane_weight(gap, point, centre, noise, weight):
    """Cauchy's weight over the variance of a distance from a plane: weight / (sigma^2 + gap^2)."""
    away = point - centre
    return weight / (noise * noise + GROUND_SLOPE * GROUND_SLOPE * (away @ away) + gap * gap)


@njit("float64[:, ::1](float64[::1])", cache=True, nogil=True)
def _turn(phi):
    """The rotation matrix of a rotation vector, by Rodrigues' formula."""
    angle = np.sqrt(phi @ phi)
    x, y, z = phi
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + cross
    return np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * (cross @ cross)


@njit("Tuple((float64[:, ::1], float64[:, ::1]))(float64[:, ::1], float64[:, ::1], float64[:, :, ::1],"
      "float64[:, :, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1],"
      "float64[:, ::1], float64[:, ::1], float64, float64, float64, float64)", cache=True, nogil=True)  # fmt: skip
def least_cost(
    source, target, source_covariances, target_covariances, source_patches, target_planes, target_normals,
    target_patches, source_planes, source_normals, T_target_source, noise, share, ground_noise, ground_weight,
):  # fmt: skip
    """Gauss-Newton with Cauchy's weights, until a step is nothing; the pose and J^T W J at the last."""
    T = T_target_source.copy()
    H, g, J = np.zeros((6, 6)), np.zeros(6), np.zeros((3, 6))
    J[:, 3:] = np.eye(3)
    for _ in range(MAX_STEPS):
        H[:], g[:] = 0.0, 0.0
        R, t = T[:3, :3].copy(), T[:3, 3].copy()
        for i in range(len(source)):
            x, y, z = source[i]
            J[:, :3] = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
            e = (target[i] - t) @ R - source[i]
            W = _weight_matrix(source_covariances[i], target_covariances[i], R, noise, share)
            W = W / (1.0 + e @ W @ e / 3.0)
            H += J.T @ W @ J
            g += J.T @ (W @ e)
        for i in range(len(source_patches)):
            normal = target_normals[i] @ R
            gap = normal @ ((target_planes[i] - t) @ R - source_patches[i])
            weight = _plane_weight(gap, R @ source_patches[i] + t, target_planes[i], ground_noise, ground_weight)
            _add_plane(H, g, source_patches[i], normal, gap, weight)
        for i in range(len(target_patches)):
            point = (target_patches[i] - t) @ R
            gap = source_normals[i] @ (point - source_planes[i])
            weight = _plane_weight(gap, point, source_planes[i], ground_noise, ground_weight)
            _add_plane(H, g, point, source_normals[i], gap, weight)
        step = np.linalg.solve(H + 1e-9 * np.eye(6), g)  # a singular H is found out afterwards
        T[:3, 3] += R @ step[3:]
        T[:3, :3] = R @ _turn(step[:3])
        if np.abs(step).max() < STEP_DONE:
            break
    return T, H
