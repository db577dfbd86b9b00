"""The pose that best lays the source's Gaussians, and its ground, on the target's. Not in the paper.

Truncated least squares knows one bound for all. But what is seen of a car or a trunk changes with the view, by some
share of its extent in each direction: a centroid is taken to be off by a Gaussian whose covariance is

    noise^2 I + share^2 (Sigma of the cluster),

and the squared Mahalanobis distance of two centroids under a pose is m = e^T S^-1 e, S being the sum of both. The pose
minimises sum 3 log(1 + m / 3) over the correspondences that are the nearest for both their ends and have m below a
gate: by Gauss-Newton with the weights of that cost (Cauchy's), the correspondences chosen anew in each step, as in
generalised ICP (Segal, Haehnel, Thrun, RSS 2009). The ground adds the distances, with the same kind of weight, of the
source's patches from the planes of the nearest patches of the target.

All is done in the frame of the source: e = R^T (b - t) - a, which a perturbation T exp([phi; rho]) turns into
e - phi x a - rho.
"""

import numpy as np
from numba import njit

from segslam import geometry
from segslam.config import SegregatorConfig
from segslam.segregator.correspondences import Correspondences
from segslam.segregator.solver import PoseFit
from segslam.types import Description, Information, Rejected, RejectReason, Transform, Vector

GATE = 11.345
"""0.99 quantile of chi-square with 3 degrees of freedom."""
MAX_STEPS = 20
STEP_DONE = 1e-5
"""Chosen: rad or m, of the step after which no other is made."""
GROUND_REACH_M = 4.0
"""Chosen: patches farther apart are not compared: as far as the next cell of `ground_patches`."""


def align_gaussians(
    correspondences: Correspondences,
    source: Description,
    target: Description,
    T_target_source: Transform,
    *,
    config: SegregatorConfig,
) -> PoseFit | Rejected:
    """The pose nearby that best lays the source on the target; its inliers are rows of `correspondences`.

    `score` counts the inliers, each from 1 where it fits exactly down to 0 at the gate. `information` is that of the
    noise model. Returns `Rejected` with DEGENERATE where that leaves the pose open by more than the paper calls a
    success, and TOO_FEW_INLIERS below the size that a clique must have.
    """
    for _ in range(MAX_STEPS):
        squared, information, gradient = _equations(correspondences, source, target, T_target_source, config)
        if _leaves_open(information):
            return Rejected(RejectReason.DEGENERATE, "clusters and ground leave the pose open")
        step = np.linalg.solve(information, gradient)
        if np.abs(step).max() < STEP_DONE:
            break
        T_target_source = T_target_source @ geometry.exp(step)
    inliers = np.isfinite(squared)
    if inliers.sum() < config.min_clique:
        return Rejected(RejectReason.TOO_FEW_INLIERS, f"{inliers.sum()} < {config.min_clique}")
    gaps = correspondences.target[inliers] - geometry.apply(T_target_source, correspondences.source[inliers])
    return PoseFit(
        T_target_source=T_target_source,
        inliers=inliers,
        rms_m=float(np.sqrt(np.mean(np.sum(gaps**2, axis=1)))),
        score=float(np.sum(1.0 - squared[inliers] / GATE)),
        information=information,
    )


def _equations(
    correspondences: Correspondences,
    source: Description,
    target: Description,
    T_target_source: Transform,
    config: SegregatorConfig,
) -> tuple[Vector, Information, Vector]:
    """Squared distances, infinite for all but inliers, and the normal equations of clusters and ground together."""
    T_source_target = geometry.inverse(T_target_source)
    sides = (
        correspondences.source,
        geometry.apply(T_source_target, correspondences.target),
        correspondences.source_covariances,
        correspondences.target_covariances,
        np.ascontiguousarray(T_source_target[:3, :3]),
    )
    noise = config.centroid_noise_m, config.centroid_noise_share
    squared = squared_distances(*sides, *noise)
    keep_nearest(squared, correspondences.source_index, correspondences.target_index)
    information, gradient = centroid_equations(*sides, squared, *noise)
    near, near_normals = source.ground_points.astype(np.float64), source.ground_normals.astype(np.float64)
    far = geometry.apply(T_source_target, target.ground_points)
    far_normals = target.ground_normals @ T_target_source[:3, :3]
    trust = config.ground_noise_m, config.ground_weight
    add_planes(information, gradient, near, far, far_normals, 1.0, *trust)
    add_planes(information, gradient, far, near, near_normals, -1.0, *trust)
    return squared, information, gradient


def _leaves_open(information: Information) -> bool:
    """Whether some standard deviation of the pose is above 5 degrees or 2 m."""
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        return True
    sigma = np.sqrt(np.diagonal(np.linalg.inv(information)))
    return bool(np.any(sigma > geometry.tangent(rotation_rad=np.radians(5.0), translation_m=2.0)))


@njit("float64(float64[:, ::1], float64[:, ::1], int64, int64)", cache=True, nogil=True)
def _turned(matrix, R, row, column):
    """One entry of R M R^T."""
    entry = 0.0
    for u in range(3):
        for v in range(3):
            entry += R[row, u] * matrix[u, v] * R[column, v]
    return entry


@njit("float64[::1, :](float64[:, ::1], float64[:, ::1], float64[:, ::1], float64, float64)", cache=True, nogil=True)
def _weight_matrix(source_covariance, target_covariance, R, noise, share):
    """Inverse of the covariance of the difference of two centroids, in the source's frame."""
    covariance = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            extent = source_covariance[row, column] + _turned(target_covariance, R, row, column)
            covariance[row, column] = share * share * extent + (2.0 * noise * noise if row == column else 0.0)
    return np.linalg.inv(covariance)


@njit("float64[::1](float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[:, ::1], float64,"
      "float64)", cache=True, nogil=True)  # fmt: skip
def squared_distances(source, target, source_covariances, target_covariances, R, noise, share):
    """Mahalanobis distances of matched centroids, squared; infinite above the gate. All in the source's frame."""
    squared = np.full(len(source), np.inf)
    for i in range(len(source)):
        e = target[i] - source[i]
        extent = np.trace(source_covariances[i]) + np.trace(target_covariances[i])
        if e @ e <= GATE * (6.0 * noise * noise + share * share * extent):  # else the gate is passed in no direction
            distance = e @ _weight_matrix(source_covariances[i], target_covariances[i], R, noise, share) @ e
            if distance < GATE:
                squared[i] = distance
    return squared


@njit("void(float64[::1], int64[::1], int64[::1])", cache=True, nogil=True)
def keep_nearest(squared, source_index, target_index):
    """Makes infinite what is not the least for both its ends."""
    best_source, best_target = np.full(source_index.max() + 1, np.inf), np.full(target_index.max() + 1, np.inf)
    for i in range(len(squared)):
        best_source[source_index[i]] = min(best_source[source_index[i]], squared[i])
        best_target[target_index[i]] = min(best_target[target_index[i]], squared[i])
    for i in range(len(squared)):
        if squared[i] > best_source[source_index[i]] or squared[i] > best_target[target_index[i]]:
            squared[i] = np.inf


@njit("Tuple((float64[:, ::1], float64[::1]))(float64[:, ::1], float64[:, ::1], float64[:, :, ::1],"
      "float64[:, :, ::1], float64[:, ::1], float64[::1], float64, float64)", cache=True, nogil=True)  # fmt: skip
def centroid_equations(source, target, source_covariances, target_covariances, R, squared, noise, share):
    """J^T W J and J^T W e over the rows whose squared distance is finite, with Cauchy's weights."""
    information, gradient = np.zeros((6, 6)), np.zeros(6)
    J = np.zeros((3, 6))
    for i in range(len(source)):
        if squared[i] < np.inf:
            x, y, z = source[i]
            J[:, :3] = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # phi x a = -[a]x phi
            J[:, 3:] = np.eye(3)
            W = _weight_matrix(source_covariances[i], target_covariances[i], R, noise, share)
            WJ = W @ J / (1.0 + squared[i] / 3.0)
            information += J.T @ WJ
            gradient += WJ.T @ (target[i] - source[i])
    return information, gradient


@njit("void(float64[:, ::1], float64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64, float64,"
      "float64)", cache=True, nogil=True)  # fmt: skip
def add_planes(information, gradient, points, centres, normals, sign, noise, weight):
    """The same for the distances of points from the plane of the nearest centre; `sign` is -1 where points move back.

    All in the source's frame. A plane is trusted less the farther its centre is, by 4 cm a metre (chosen).
    """
    row = np.empty(6)
    for i in range(len(points)):
        nearest, best = -1, GROUND_REACH_M**2
        for k in range(len(centres)):
            gap = (
                (centres[k, 0] - points[i, 0]) ** 2
                + (centres[k, 1] - points[i, 1]) ** 2
                + (centres[k, 2] - points[i, 2]) ** 2
            )
            if gap < best:
                nearest, best = k, gap
        if nearest >= 0:
            n = normals[nearest]
            e = sign * (n @ (centres[nearest] - points[i]))
            row[:3] = np.cross(points[i], n)
            row[3:] = n
            variance = noise * noise + 0.04 * 0.04 * best
            w = weight / (variance + e * e)
            for r in range(6):
                gradient[r] += w * e * row[r]
                for c in range(6):
                    information[r, c] += w * row[r] * row[c]
