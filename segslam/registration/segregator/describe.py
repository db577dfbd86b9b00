"""The description of a scan for matching, computed once per scan."""

import numpy as np

from segslam.core.config import SegregatorConfig
from segslam.core.types import Description, Labels, Points
from segslam.registration.segregator.clusters import MAX_RANGE_M, Clusters, semantic_clusters
from segslam.registration.segregator.features import NO_FEATURES, point_features
from segslam.registration.segregator.feet import ground_cells, stand_on_ground
from segslam.registration.segregator.ground_patches import ground_patches

FOOT_MAX_DISTANCE_M = 10.0
"""Chosen: largest distance to the ground patch below such a cluster (m)."""
FEW_CLUSTERS = 24
"""Chosen on simulated 00 and 08: number of clusters below which a scan has few clusters."""


def describe(points: Points, labels: Labels, *, config: SegregatorConfig) -> Description:
    """The semantic clusters, point features and ground of a scan, in its frame, whose origin is the sensor.

    Points that are NaN or out of range are ignored; a scan without usable points has an empty description. The result
    does not depend on the order of the points. Raises ValueError unless points are rows of three and labels as many.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points of shape {points.shape}; give a row x, y, z for each")
    if len(points) != len(labels):
        raise ValueError(f"{len(points)} points but {len(labels)} labels; give one label for each point")
    clusters = _grounded(semantic_clusters(points, labels, config=config), points, labels, config)
    wanted = config.features == "always" or (
        config.features == "when_few_clusters" and len(clusters.sizes) < FEW_CLUSTERS
    )
    features = point_features(points, labels, config=config) if wanted else NO_FEATURES
    ground = ground_patches(points, labels)
    return Description(
        means=clusters.means,
        covariances=clusters.covariances,
        classes=clusters.classes,
        sizes=clusters.sizes,
        feature_points=features.points,
        feature_covariances=features.covariances,
        feature_classes=features.classes,
        feature_descriptors=features.descriptors,
        ground_points=ground.points,
        ground_normals=ground.normals,
    )


def _grounded(clusters: Clusters, points: Points, labels: Labels, config: SegregatorConfig) -> Clusters:
    upright = np.isin(clusters.classes, [int(label) for label in config.foot_classes])
    if not upright.any():
        return clusters
    ground = ground_cells(points, labels, reach_m=MAX_RANGE_M)
    return stand_on_ground(clusters, upright, ground, max_distance_m=FOOT_MAX_DISTANCE_M)
