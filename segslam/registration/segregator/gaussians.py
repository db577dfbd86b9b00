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
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.kernels import kernel
from segslam.core.types import (
    Description,
    Indices,
    Information,
    Points,
    Rejected,
    RejectReason,
    Transform,
    Vector,
)
from segslam.registration.segregator.correspondences import Correspondences
from segslam.registration.segregator.descent import GATE, least_cost, squared_distances
from segslam.registration.segregator.pose_solver import PoseFit

CENTROID_NOISE_M = 0.07
"""Measured (simulated truth): noise of a centroid in each direction (m)."""
CENTROID_NOISE_SHARE = 0.35
"""Measured (simulated truth): additional noise of a centroid, as a share of its cluster's standard deviation."""
SHARED_NOISE_M = 0.045
"""Measured (simulated truth): noise common to all centroids, in the information matrix only (m)."""
SHARED_NOISE_DEG = 0.05
"""Measured (simulated truth): rotation noise common to all centroids, for example from sensor calibration (degrees)."""
GROUND_NOISE_M = 0.1
"""Chosen: noise of the distance between two ground patches (m)."""
GROUND_WEIGHT = 0.3
"""Chosen: weight of such a distance; below 1 because the errors of neighbours are correlated."""

MAX_ROUNDS = 8
GROUND_REACH_M = 4.0
"""Chosen: largest distance of compared patches: the next cell of `ground_patches` (m)."""


class Planes(NamedTuple):
    """Points of one scan, and the matching patch of the other scan for each; both in the frames of their scans."""

    points: Points
    centres: Points
    normals: Points


def align_gaussians(
    correspondences: Correspondences,
    source: Description,
    target: Description,
    T_target_source: Transform,
    *,
    config: SegregatorConfig,
) -> PoseFit | Rejected:
    """The pose of least cost near an initial guess; its inliers are rows of `correspondences`.

    `score` sums the inliers, each between 1 (exact) and 0 (at the gate). `information` follows from the noise model,
    including the noise common to all clusters. Returns `Rejected` with TOO_FEW_INLIERS below `min_clique`, and with
    DEGENERATE if a standard deviation of the pose exceeds the limits of a correct registration.
    """
    rows: Indices = np.empty(0, np.int64)
    for _ in range(MAX_ROUNDS):
        previous, rows = rows, nearest_pairs(correspondences, T_target_source)
        if len(rows) < config.min_clique:
            return Rejected(RejectReason.TOO_FEW_INLIERS, f"{len(rows)} < {config.min_clique}")
        if np.array_equal(rows, previous):
            break
        pairs = correspondences.take(rows)
        T_target_source, information = descend(pairs, source, target, T_target_source)
        if _leaves_open(information):
            return Rejected(RejectReason.DEGENERATE, "clusters and ground leave the pose open")
    gaps = pairs.target - geometry.apply(T_target_source, pairs.source)
    return PoseFit(
        T_target_source=T_target_source,
        inliers=np.isin(np.arange(len(correspondences)), rows),
        rms_m=float(np.sqrt(np.mean(np.sum(gaps**2, axis=1)))),
        score=float(np.sum(1.0 - np.minimum(_squared(pairs, T_target_source) / GATE, 1.0))),
        information=geometry.with_noise(
            information,
            rotation_rad=math.radians(SHARED_NOISE_DEG),
            translation_m=SHARED_NOISE_M,
        ),
    )


def nearest_pairs(correspondences: Correspondences, T_target_source: Transform) -> Indices:
    """Rows, ascending, within the gate that have the smallest distance among all rows sharing one of their ends."""
    squared = _squared(correspondences, T_target_source)
    return _least_at_both_ends(squared, correspondences.source_index, correspondences.target_index)


def nearest_planes(scan: Description, other: Description, T_other_scan: Transform) -> Planes:
    """The ground of `scan`: the centre of each patch, with the nearest patch of `other` at this pose."""
    points = geometry.apply(T_other_scan, scan.ground_points)
    nearest = _nearest_within(points, other.ground_points.astype(np.float64), GROUND_REACH_M)
    met = nearest >= 0
    sides = scan.ground_points[met], other.ground_points[nearest[met]], other.ground_normals[nearest[met]]
    return Planes(*(side.astype(np.float64) for side in sides))


def descend(
    pairs: Correspondences,
    source: Description,
    target: Description,
    T_target_source: Transform,
) -> tuple[Transform, Information]:
    """The pose of least cost for these pairs and the current pairs of ground patches, and the Hessian there."""
    return least_cost(
        pairs.source,
        pairs.target,
        pairs.source_covariances,
        pairs.target_covariances,
        *nearest_planes(source, target, T_target_source),
        *nearest_planes(target, source, geometry.inverse(T_target_source)),
        T_target_source,
        CENTROID_NOISE_M,
        CENTROID_NOISE_SHARE,
        GROUND_NOISE_M,
        GROUND_WEIGHT,
    )


def _squared(correspondences: Correspondences, T_target_source: Transform) -> Vector:
    return squared_distances(
        correspondences.source,
        correspondences.target,
        correspondences.source_covariances,
        correspondences.target_covariances,
        T_target_source,
        CENTROID_NOISE_M,
        CENTROID_NOISE_SHARE,
    )


def _leaves_open(information: Information) -> bool:
    """True if a standard deviation of the pose exceeds 5 degrees or 2 m."""
    values, axes = np.linalg.eigh(information)
    if values[0] <= 1e-9 * values[-1]:  # singular up to rounding
        return True
    sigma = np.sqrt(np.sum(axes**2 / values, axis=1))
    return bool(np.any(sigma > geometry.tangent(rotation_rad=np.radians(5.0), translation_m=2.0)))


def _least_at_both_ends(squared: Vector, source_index: Indices, target_index: Indices) -> Indices:
    """Rows below the gate with the smallest distance among all rows that share one of their ends."""
    bound = np.full(len(squared), GATE)
    for ends in (source_index, target_index):
        best = np.full(ends.max(initial=0) + 1, GATE)
        np.minimum.at(best, ends, squared)
        bound = np.minimum(bound, best[ends])
    return np.flatnonzero((squared < GATE) & (squared <= bound))


@kernel("int64[::1](float64[:, ::1], float64[:, ::1], float64)")
def _nearest_within(points, others, reach):
    """Row of the nearest other point for each point, -1 if none is within reach."""
    nearest = np.full(len(points), -1)
    for i in range(len(points)):
        best = reach * reach
        for k in range(len(others)):
            gap = (
                (others[k, 0] - points[i, 0]) ** 2
                + (others[k, 1] - points[i, 1]) ** 2
                + (others[k, 2] - points[i, 2]) ** 2
            )
            if gap < best:
                nearest[i], best = k, gap
    return nearest
