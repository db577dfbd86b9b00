"""The pose that best lays the source's Gaussians, and its ground, on the target's. Not in the paper.

Truncated least squares knows one bound for all. But what is seen of a car or a trunk changes with the view, by some
share of its extent in each direction: a centroid is taken to be off by a Gaussian whose covariance is

    noise^2 I + share^2 (Sigma of the cluster),

and the squared Mahalanobis distance of two centroids under a pose is m = e^T S^-1 e, S being the sum of both. The pose
minimises sum 3 log(1 + m / 3), Cauchy's cost, over the correspondences that are the nearest for both their ends and
have m below a gate, these being chosen anew until they stay the same, as in generalised ICP (Segal, Haehnel, Thrun,
RSS 2009). The ground adds the same cost for the distances of each scan's patches from the planes of the other's.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from segslam import geometry
from segslam.config import SegregatorConfig
from segslam.segregator.correspondences import Correspondences
from segslam.segregator.descent import GATE, least_cost, squared_distances
from segslam.segregator.solver import PoseFit
from segslam.types import Description, Indices, Information, Points, Rejected, RejectReason, Transform, Vector

MAX_ROUNDS = 8
GROUND_REACH_M = 4.0
"""Chosen: patches farther apart are not compared: as far as the next cell of `ground_patches`."""


class Planes(NamedTuple):
    """Points of one scan, and for each the patch of the other that it should lie on. Each in its own scan's frame."""

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
    """The pose nearby that best lays the source on the target; its inliers are rows of `correspondences`.

    `score` counts the inliers, each from 1 where it fits exactly down to 0 at the gate. `information` is that of the
    noise model, and of the noise that all clusters share. Returns `Rejected` with
    TOO_FEW_INLIERS below the size that a clique must have, and with DEGENERATE where the pose is left open by more than
    the paper calls a success.
    """
    rows: Indices = np.empty(0, np.int64)
    for _ in range(MAX_ROUNDS):
        previous, rows = rows, nearest_pairs(correspondences, T_target_source, config=config)
        if len(rows) < config.min_clique:
            return Rejected(RejectReason.TOO_FEW_INLIERS, f"{len(rows)} < {config.min_clique}")
        if np.array_equal(rows, previous):
            break
        pairs = correspondences.take(rows)
        T_target_source, information = descend(pairs, source, target, T_target_source, config=config)
        if _leaves_open(information):
            return Rejected(RejectReason.DEGENERATE, "clusters and ground leave the pose open")
    gaps = pairs.target - geometry.apply(T_target_source, pairs.source)
    return PoseFit(
        T_target_source=T_target_source,
        inliers=np.isin(np.arange(len(correspondences)), rows),
        rms_m=float(np.sqrt(np.mean(np.sum(gaps**2, axis=1)))),
        score=float(np.sum(1.0 - np.minimum(_squared(pairs, T_target_source, config) / GATE, 1.0))),
        information=geometry.with_noise(
            information,
            rotation_rad=math.radians(config.shared_noise_deg),
            translation_m=config.shared_noise_m,
        ),
    )


def nearest_pairs(correspondences: Correspondences, T_target_source: Transform, *, config: SegregatorConfig) -> Indices:
    """Rows, ascending, that fit the pose within the gate, and no worse than any other row with one of their ends."""
    squared = _squared(correspondences, T_target_source, config)
    return _least_at_both_ends(squared, correspondences.source_index, correspondences.target_index)


def nearest_planes(scan: Description, other: Description, T_other_scan: Transform) -> Planes:
    """The ground of `scan`, each patch as a point with the patch of `other` that is nearest under the pose."""
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
    *,
    config: SegregatorConfig,
) -> tuple[Transform, Information]:
    """The pose of least cost for these pairs, and for the ground as it is paired now; and the Hessian there."""
    return least_cost(
        pairs.source,
        pairs.target,
        pairs.source_covariances,
        pairs.target_covariances,
        *nearest_planes(source, target, T_target_source),
        *nearest_planes(target, source, geometry.inverse(T_target_source)),
        T_target_source,
        config.centroid_noise_m,
        config.centroid_noise_share,
        config.ground_noise_m,
        config.ground_weight,
    )


def _squared(correspondences: Correspondences, T_target_source: Transform, config: SegregatorConfig) -> Vector:
    return squared_distances(
        correspondences.source,
        correspondences.target,
        correspondences.source_covariances,
        correspondences.target_covariances,
        T_target_source,
        config.centroid_noise_m,
        config.centroid_noise_share,
    )


def _leaves_open(information: Information) -> bool:
    """Whether some standard deviation of the pose is above 5 degrees or 2 m."""
    values, axes = np.linalg.eigh(information)
    if values[0] <= 1e-9 * values[-1]:  # singular but for rounding
        return True
    sigma = np.sqrt(np.sum(axes**2 / values, axis=1))
    return bool(np.any(sigma > geometry.tangent(rotation_rad=np.radians(5.0), translation_m=2.0)))


@njit("int64[::1](float64[::1], int64[::1], int64[::1])", cache=True, nogil=True)
def _least_at_both_ends(squared, source_index, target_index):
    """Rows below the gate that no row with one of their ends is below."""
    best_source, best_target = np.full(source_index.max() + 1, GATE), np.full(target_index.max() + 1, GATE)
    for i in range(len(squared)):
        best_source[source_index[i]] = min(best_source[source_index[i]], squared[i])
        best_target[target_index[i]] = min(best_target[target_index[i]], squared[i])
    bound = np.minimum(best_source[source_index], best_target[target_index])
    return np.flatnonzero((squared < GATE) & (squared <= bound))


@njit("int64[::1](float64[:, ::1], float64[:, ::1], float64)", cache=True, nogil=True)
def _nearest_within(points, others, reach):
    """Row of the nearest other point to each, -1 where none is within reach."""
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
