"""Registration of the Gaussians and the ground of two scans, weighted by covariances. Not in the paper.

Truncated least squares has one bound for all points. But the visible part of a car or trunk changes with the viewpoint,
in proportion to its extent in each direction. The error of a centroid is modelled as Gaussian with covariance

    noise^2 I + share^2 (Sigma of the cluster),

and the squared Mahalanobis distance of two centroids under a pose is m = e^T S^-1 e, S being the sum of both. The pose
minimises sum 3 log(1 + m / 3), Cauchy's cost, over the mutually nearest correspondences with m below a gate. Pose and
correspondences alternate until the set no longer changes, as in generalised ICP (Segal, Haehnel, Thrun, RSS 2009). The
ground adds the same cost for the distances of each scan's patches from the planes of the other scan.
"""

import math

import numpy as np
from scipy.spatial.distance import cdist

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.types import (
    Description,
    Indices,
    Information,
    Points,
    Registration,
    Rejected,
    RejectReason,
    Transform,
)
from segslam.registration.segregator.correspondences import Correspondences
from segslam.registration.segregator.descent import GATE, least_cost, squared_distances
from segslam.registration.segregator.pose_solver import Scored

SHARED_NOISE_M = 0.045
"""Measured (simulated truth): noise common to all centroids, in the information matrix only (m)."""
SHARED_NOISE_DEG = 0.05
"""Measured (simulated truth): rotation noise common to all centroids, for example from sensor calibration (degrees)."""
SHARED_NOISE = np.diag(geometry.tangent(rotation_rad=math.radians(SHARED_NOISE_DEG), translation_m=SHARED_NOISE_M) ** 2)

MAX_ROUNDS = 8
GROUND_REACH_M = 4.0
"""Chosen: largest distance of compared patches: the next cell of `ground_patches` (m)."""


def align_gaussians(
    correspondences: Correspondences,
    source: Description,
    target: Description,
    T_target_source: Transform,
    *,
    config: SegregatorConfig,
) -> Scored | Rejected:
    """The pose of least cost near an initial guess; and its score, which is 0 at the gate.

    `information` follows from the noise model, including the noise common to all clusters. Returns `Rejected` with
    TOO_FEW_INLIERS below `min_clique`, and with DEGENERATE if a standard deviation of the pose exceeds the limits of a
    correct registration.
    """
    rows: Indices = np.empty(0, np.int64)
    for _ in range(MAX_ROUNDS):
        previous, rows = rows, nearest_pairs(correspondences, T_target_source)
        if len(rows) < config.min_clique:
            return Rejected(RejectReason.TOO_FEW_INLIERS, f"{len(rows)} < {config.min_clique}")
        if np.array_equal(rows, previous):
            break
        pairs = correspondences.take(rows)
        T_target_source, information = least_cost(
            *pairs[:4],
            *nearest_planes(source, target, T_target_source),
            *nearest_planes(target, source, geometry.inverse(T_target_source)),
            T_target_source,
        )
        if _leaves_open(information):
            return Rejected(RejectReason.DEGENERATE, "clusters and ground leave the pose open")
    gaps = pairs.target - geometry.apply(T_target_source, pairs.source)
    score = float(np.sum(1.0 - np.minimum(squared_distances(*pairs[:4], T_target_source) / GATE, 1.0)))
    return score, Registration(
        T_target_source=T_target_source,
        num_correspondences=len(correspondences.source),
        num_inliers=len(rows),
        rms_m=float(np.sqrt(np.mean(np.sum(gaps**2, axis=1)))),
        information=geometry.with_covariance(information, SHARED_NOISE),
    )


def nearest_pairs(correspondences: Correspondences, T_target_source: Transform) -> Indices:
    """Rows, ascending, within the gate that have the smallest distance among all rows sharing one of their ends."""
    squared = squared_distances(*correspondences[:4], T_target_source)
    bound = np.full(len(squared), GATE)
    for ends in (correspondences.source_index, correspondences.target_index):
        best = np.full(ends.max(initial=0) + 1, GATE)
        np.minimum.at(best, ends, squared)
        bound = np.minimum(bound, best[ends])
    return np.flatnonzero((squared < GATE) & (squared <= bound))


def nearest_planes(scan: Description, other: Description, T_other_scan: Transform) -> tuple[Points, Points, Points]:
    """The ground of `scan` that meets that of `other` at this pose: the centre of each patch, and the centre and the
    normal of the nearest patch of `other`, in the frames of their scans.
    """
    if not len(other.ground_points):
        return (np.empty((0, 3)),) * 3
    apart = cdist(geometry.apply(T_other_scan, scan.ground_points), other.ground_points, "sqeuclidean")
    nearest, met = apart.argmin(axis=1), apart.min(axis=1) < GROUND_REACH_M**2
    sides = scan.ground_points[met], other.ground_points[nearest[met]], other.ground_normals[nearest[met]]
    centres, planes, normals = (side.astype(np.float64) for side in sides)
    return centres, planes, normals


def _leaves_open(information: Information) -> bool:
    """True if a standard deviation of the pose exceeds 5 degrees or 2 m."""
    values, axes = np.linalg.eigh(information)
    if values[0] <= 1e-9 * values[-1]:  # singular up to rounding
        return True
    sigma = np.sqrt(np.sum(axes**2 / values, axis=1))
    return bool(np.any(sigma > geometry.tangent(rotation_rad=np.radians(5.0), translation_m=2.0)))
