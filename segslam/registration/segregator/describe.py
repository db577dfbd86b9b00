"""The description of a scan for matching, computed once per scan: clusters, ground, and FPFH key points.

Yin, Yuan, Cao, Ji, Zhang, Xie, "Segregator: Global Point Cloud Registration with Semantic and Geometric Cues", ICRA
2023, section III: FPFH on the voxelised cloud of each class.

Differs from the paper: only the points with the most neighbours are key points, each with the Gaussian of the patch
around it. A descriptor is the square root of its FPFH, scaled to unit length, so that Euclidean distances are Hellinger
distances of histograms (Arandjelovic, Zisserman, "Three things everyone should know to improve object retrieval", CVPR
2012).

The ground is not in the paper. The visible part of a trunk or pole, and so the height of its centre, changes with the
viewpoint; its foot on the ground does not. In 6 pairs of real scans 9 to 35 m apart, with 34 trunks, poles and signs
per scan, 7 centres are within 0.2 m of a centre in the other scan, and 16 feet of a foot.

Objects on a plane constrain tilt and height badly; the ground constrains both. With its patches, the mean rotation
error of real pairs 9 to 35 m apart is 0.1 instead of 0.2 degrees.
"""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from segslam.core.config import SegregatorConfig
from segslam.core.points import group_means, normals, patch_covariances, radius_neighbours, voxel_means, within_range
from segslam.core.types import GROUND_LABELS, Description, Indices, Label, Labels, Mask, Points
from segslam.registration.segregator.clusters import MAX_RANGE_M, MIN_RANGE_M, semantic_clusters
from segslam.registration.segregator.fpfh import fpfh

FEW_CLUSTERS = 24
"""Chosen on simulated 00 and 08: number of clusters below which a scan has few clusters."""
FEATURE_CLASSES = (Label.BUILDING, Label.VEGETATION)
"""Classes that give FPFH key points (paper: L_F)."""

MIN_PATCH_POINTS = 4
"""Chosen: three points always lie on a plane, so a normal needs at least four."""
MAX_CLOUD_POINTS = 20_000
"""Chosen: largest number of points of a class after voxelising, about four times that of real scans; the nearest
points are used if there are more."""

FOOT_MAX_DISTANCE_M = 10.0
"""Chosen: largest distance of a cluster to the ground below it."""
FOOT_CELL_M = 1.0
"""Chosen: cell size in which the ground is averaged (m)."""
NUM_FOOT_CELLS = 5
"""Chosen: number of nearest cells; their median height is that of the foot."""
CELL_M = 4.0
"""Chosen: edge of a patch (m)."""
REACH_M = 40.0
"""Chosen: farther ground, in x or y, is seen at a grazing angle and its height is inaccurate (m)."""
MIN_GROUND_POINTS = 8
MAX_THICKNESS_M = 0.15
"""Chosen: largest root mean square distance of points from the patch's plane; excludes walls and bushes, not kerbs."""
MIN_BREADTH_M = 0.3
"""Chosen: smallest root mean square extent along the shorter side; a single ring has no defined tilt (m)."""
RESOLUTION_M = 1e-4
"""Unit of the integer sums of coordinates (m)."""


def describe(points: Points, labels: Labels, *, config: SegregatorConfig) -> Description:
    """The semantic clusters, point features and ground of a scan, in its frame, whose origin is the sensor.

    Points that are NaN or out of range are ignored; a scan without usable points has an empty description. The result
    does not depend on the order of the points. Raises ValueError unless points are rows of three and labels as many.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points of shape {points.shape}; give a row x, y, z for each")
    if len(points) != len(labels):
        raise ValueError(f"{len(points)} points but {len(labels)} labels; give one label for each point")
    description = semantic_clusters(points, labels, config=config)
    upright = np.isin(description.classes, [int(label) for label in config.foot_classes])
    if upright.any():
        description = stand_on_ground(description, upright, ground_cells(points, labels))
    is_poor = config.features == "when_few_clusters" and len(description.sizes) < FEW_CLUSTERS
    if config.features == "always" or is_poor:
        description = replace(description, **point_features(points, labels, config=config))
    centres, normals = ground_patches(points, labels)
    return replace(description, ground_points=centres, ground_normals=normals)


def point_features(points: Points, labels: Labels, *, config: SegregatorConfig) -> dict[str, np.ndarray]:
    """The key points of each class in `FEATURE_CLASSES`, as fields of a description; the sensor is at the origin.

    Points that are NaN or out of range are ignored. The result does not depend on the order of the points.
    """
    parts = []
    for label in FEATURE_CLASSES:
        cloud = points[labels == label]
        cloud = cloud[within_range(cloud, MIN_RANGE_M, MAX_RANGE_M)].astype(np.float32)
        cloud = voxel_means(cloud, config.feature_voxel_m)
        nearest = np.argsort(np.linalg.norm(cloud, axis=1), kind="stable")[:MAX_CLOUD_POINTS]
        parts.append(_class_features(cloud[np.sort(nearest)], int(label), config))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _class_features(cloud: Points, label: int, config: SegregatorConfig) -> dict[str, np.ndarray]:
    """The key points of one class from its voxelised cloud; none if no point has enough neighbours."""
    patches = radius_neighbours(cloud, config.normal_radius_m)
    kept = patches.ends - patches.starts >= MIN_PATCH_POINTS
    covariances = patch_covariances(cloud, *patches)[kept]
    cloud = cloud[kept]
    around = radius_neighbours(cloud, config.feature_radius_m)
    chosen = np.sort(np.argsort(around.starts - around.ends, kind="stable")[: config.max_features_per_class])
    histograms = fpfh(cloud, normals(cloud, covariances), around, chosen)
    unit = np.sqrt(histograms / np.maximum(histograms.sum(axis=1, keepdims=True), 1.0))
    return {
        "feature_points": cloud[chosen].astype(np.float32),
        "feature_covariances": covariances[chosen].astype(np.float32),
        "feature_classes": np.full(len(chosen), label, np.uint8),
        "feature_descriptors": unit.astype(np.float16),
    }


def stand_on_ground(clusters: Description, upright: Mask, ground: Points) -> Description:
    """The clusters, with the `upright` ones moved along z to the ground around them: the median of the nearest cells.

    `ground` comes from `ground_cells`, in the clusters' frame. A cluster without ground within `FOOT_MAX_DISTANCE_M`
    (horizontally) is not moved. Covariances do not change.
    """
    if not len(ground):
        return clusters
    columns = range(1, min(NUM_FOOT_CELLS, len(ground)) + 1)
    distances, nearest = map(np.asarray, cKDTree(ground[:, :2]).query(clusters.means[:, :2], k=columns))
    moved = upright & (distances[:, 0] <= FOOT_MAX_DISTANCE_M)
    means = clusters.means.copy()
    means[moved, 2] = np.median(ground[nearest[moved], 2], axis=1)
    return replace(clusters, means=means)


def ground_cells(points: Points, labels: Labels) -> Points:
    """The mean ground point of each occupied square cell, within `MAX_RANGE_M` in x, y and z.

    Sums in float64 of float32 values above 1e-5 m are exact, so they do not depend on the order of points.
    """
    with np.errstate(over="ignore"):  # what float32 cannot hold is out of reach
        ground = _ground(points.astype(np.float32), labels, MAX_RANGE_M)
    return _cell_means(ground, ground, MAX_RANGE_M, FOOT_CELL_M)[0]


def ground_patches(points: Points, labels: Labels) -> tuple[Points, Points]:
    """Centres (m) and unit normals of the ground patches of a scan, a row each, float32, in the frame of `points`.

    Its origin is the sensor, towards which the normals point. NaN points are ignored.
    """
    ground = _ground(points, labels, REACH_M)
    x, y, z = np.rint(ground / RESOLUTION_M).T  # sums of integers do not depend on the order of points
    moments = np.column_stack([x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    means, counts = _cell_means(ground, moments, REACH_M, CELL_M)
    means = means[counts >= MIN_GROUND_POINTS]
    centres = means[:, :3] * RESOLUTION_M
    squares = means[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3) * RESOLUTION_M**2
    variances, axes = np.linalg.eigh(squares - centres[:, :, None] * centres[:, None, :])
    flat = (variances[:, 0] <= MAX_THICKNESS_M**2) & (variances[:, 1] >= MIN_BREADTH_M**2)
    centres, normals = centres[flat], axes[flat, :, 0]
    away = np.sum(normals * centres, axis=1, keepdims=True) > 0.0
    return centres.astype(np.float32), np.where(away, -normals, normals).astype(np.float32)


def _ground(points: Points, labels: Labels, reach_m: float) -> Points:
    ground = points.compress(np.isin(labels, GROUND_LABELS), axis=0).astype(np.float64)
    return ground.compress((np.abs(ground) < reach_m).all(axis=1), axis=0)  # false for NaN


def _cell_means(ground: Points, rows: np.ndarray, reach_m: float, cell_m: float) -> tuple[np.ndarray, Indices]:
    """Mean of the rows, one for each point, in each occupied cell of a square grid, and the number of its points."""
    i, j = ((ground[:, :2] + reach_m) / cell_m).astype(np.int64).T
    cell = i * math.ceil(2.0 * reach_m / cell_m) + j
    counts = np.bincount(cell)
    return group_means(rows, cell, len(counts))[counts > 0], counts[counts > 0]
