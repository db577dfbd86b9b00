"""Point features of background classes: FPFH key points, each with the Gaussian of the patch around it.

Yin, Yuan, Cao, Ji, Zhang, Xie, "Segregator", ICRA 2023, section III-B. FPFH: Rusu, Blodow, Beetz, "Fast Point Feature
Histograms (FPFH) for 3D registration", ICRA 2009.
"""

from typing import NamedTuple

import numpy as np
import open3d as o3d
from jaxtyping import Float
from scipy.spatial import cKDTree

from segslam.config import SegregatorConfig
from segslam.points import voxel_means, within_range
from segslam.types import Covariances, Labels, Points


class Features(NamedTuple):
    """Key points, a row each: position (m), covariance of the patch (m^2), class, FPFH descriptor. float32."""

    points: Points
    covariances: Covariances
    classes: Labels
    descriptors: Float[np.ndarray, "_ 33"]


NO_FEATURES = Features(
    np.empty((0, 3), np.float32), np.empty((0, 3, 3), np.float32), np.empty(0, np.uint8), np.empty((0, 33), np.float32)
)


def point_features(points: Points, labels: Labels, *, config: SegregatorConfig) -> Features:
    """The key points of each class in `config.feature_classes`, in the frame of `points`, whose origin is the sensor."""
    parts = []
    for label in config.feature_classes:
        cloud = points[labels == label]
        cloud = cloud[within_range(cloud, config.min_range_m, config.max_range_m)]
        parts.append(_class_features(voxel_means(cloud, config.feature_voxel_m), int(label), config))
    return Features(*(np.concatenate(columns) for columns in zip(NO_FEATURES, *parts, strict=True)))


def _class_features(cloud: Points, label: int, config: SegregatorConfig) -> Features:
    if not len(cloud):
        return NO_FEATURES
    pcd = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud))
    pcd.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(config.normal_radius_m))
    pcd.orient_normals_towards_camera_location()
    fpfh = o3d.pipelines.registration.compute_fpfh_feature(
        pcd, o3d.geometry.KDTreeSearchParamRadius(config.feature_radius_m)
    )
    kept = np.arange(0, len(cloud), max(1, len(cloud) // 500))
    neighbours = cKDTree(cloud).query_ball_point(cloud[kept], config.patch_radius_m)
    covariances = np.array([np.cov(cloud[rows].T, bias=True) for rows in neighbours])
    return Features(
        cloud[kept].astype(np.float32),
        covariances.astype(np.float32),
        np.full(len(kept), label, np.uint8),
        fpfh.data.T[kept].astype(np.float32),
    )
