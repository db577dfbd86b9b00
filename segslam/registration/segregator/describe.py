"""The description of a scan for matching, computed once per scan: clusters, ground, and FPFH key points.

Yin, Yuan, Cao, Ji, Zhang, Xie, "Segregator: Global Point Cloud Registration with Semantic and Geometric Cues", ICRA
2023, section III: FPFH on the voxelised cloud of each class.

Differs from the paper: only the points with the most neighbours are key points, each with the Gaussian of the patch
around it. A descriptor is the square root of its FPFH, scaled to unit length, so that Euclidean distances are Hellinger
distances of histograms (Arandjelovic, Zisserman, "Three things everyone should know to improve object retrieval", CVPR
2012).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from segslam.core.config import SegregatorConfig
from segslam.core.points import normals, patch_covariances, radius_neighbours, voxel_means, within_range
from segslam.core.types import Covariances, Description, Label, Labels, Points
from segslam.registration.segregator.clusters import MAX_RANGE_M, MIN_RANGE_M, semantic_clusters
from segslam.registration.segregator.fpfh import fpfh
from segslam.registration.segregator.ground import ground_cells, ground_patches, stand_on_ground

FEW_CLUSTERS = 24
"""Chosen on simulated 00 and 08: number of clusters below which a scan has few clusters."""
FEATURE_CLASSES = (Label.BUILDING, Label.VEGETATION)
"""Classes that give FPFH key points (paper: L_F)."""

MIN_PATCH_POINTS = 4
"""Chosen: three points always lie on a plane, so a normal needs at least four."""
MAX_CLOUD_POINTS = 20_000
"""Chosen: largest number of points of a class after voxelising, about four times that of real scans; the nearest
points are used if there are more."""


class Features(NamedTuple):
    """Key points, a row each: position (m), covariance of the patch (m^2), class, descriptor of unit length.

    float32, the descriptors float16.
    """

    points: Points
    covariances: Covariances
    classes: Labels
    descriptors: Float[np.ndarray, "_ 33"]


NO_FEATURES = Features(
    np.empty((0, 3), np.float32), np.empty((0, 3, 3), np.float32), np.empty(0, np.uint8), np.empty((0, 33), np.float16)
)


def describe(points: Points, labels: Labels, *, config: SegregatorConfig) -> Description:
    """The semantic clusters, point features and ground of a scan, in its frame, whose origin is the sensor.

    Points that are NaN or out of range are ignored; a scan without usable points has an empty description. The result
    does not depend on the order of the points. Raises ValueError unless points are rows of three and labels as many.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points of shape {points.shape}; give a row x, y, z for each")
    if len(points) != len(labels):
        raise ValueError(f"{len(points)} points but {len(labels)} labels; give one label for each point")
    clusters = semantic_clusters(points, labels, config=config)
    upright = np.isin(clusters.classes, [int(label) for label in config.foot_classes])
    if upright.any():
        clusters = stand_on_ground(clusters, upright, ground_cells(points, labels))
    wanted = config.features == "always" or (
        config.features == "when_few_clusters" and len(clusters.sizes) < FEW_CLUSTERS
    )
    features = point_features(points, labels, config=config) if wanted else NO_FEATURES
    return Description(*clusters, *features, *ground_patches(points, labels))


def point_features(points: Points, labels: Labels, *, config: SegregatorConfig) -> Features:
    """The key points of each class in `FEATURE_CLASSES`, in the frame of `points`; the sensor is at its origin.

    Points that are NaN or out of range are ignored. The result does not depend on the order of the points.
    """
    parts = []
    for label in FEATURE_CLASSES:
        cloud = points[labels == label]
        cloud = cloud[within_range(cloud, MIN_RANGE_M, MAX_RANGE_M)].astype(np.float32)
        cloud = voxel_means(cloud, config.feature_voxel_m)
        nearest = np.argsort(np.linalg.norm(cloud, axis=1), kind="stable")[:MAX_CLOUD_POINTS]
        parts.append(_class_features(cloud[np.sort(nearest)], int(label), config))
    return Features(*(np.concatenate(columns) for columns in zip(NO_FEATURES, *parts, strict=True)))


def _class_features(cloud: Points, label: int, config: SegregatorConfig) -> Features:
    """The key points of one class from its voxelised cloud; none if no point has enough neighbours."""
    patches = radius_neighbours(cloud, config.normal_radius_m)
    kept = patches.ends - patches.starts >= MIN_PATCH_POINTS
    covariances = patch_covariances(cloud, patches)[kept]
    cloud = cloud[kept]
    around = radius_neighbours(cloud, config.feature_radius_m)
    chosen = np.sort(np.argsort(around.starts - around.ends, kind="stable")[: config.max_features_per_class])
    histograms = fpfh(cloud, normals(cloud, covariances), around, chosen)
    return Features(
        points=cloud[chosen].astype(np.float32),
        covariances=covariances[chosen].astype(np.float32),
        classes=np.full(len(chosen), label, np.uint8),
        descriptors=np.sqrt(histograms / np.maximum(histograms.sum(axis=1, keepdims=True), 1.0)).astype(np.float16),
    )
