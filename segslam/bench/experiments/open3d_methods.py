"""Registration by Open3D with the settings of its examples. Imported on use, because Open3D is large."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d

from segslam.bench.experiments.baselines import Estimate
from segslam.core.types import Points, Rejected, RejectReason

OPEN3D_VOXEL_M = 0.5
"""Chosen: voxel size of Segregator's authors for FPFH. Other lengths are multiples of it, as in Open3D's examples."""
TOOLS: Any = open3d.pipelines.registration
RANSAC_ITERATIONS, RANSAC_CONFIDENCE = 100_000, 0.999
SEED = 0


@dataclass(frozen=True, slots=True, eq=False)
class FpfhScan:
    """Voxel means with their FPFH, (33, n)."""

    points: Points
    features: np.ndarray


def prepare_fpfh(points: Points) -> FpfhScan:
    """Open3D's FPFH of the voxelised scan."""
    near = open3d.geometry.KDTreeSearchParamHybrid
    cloud = _cloud(points).voxel_down_sample(OPEN3D_VOXEL_M)
    cloud.estimate_normals(near(radius=2 * OPEN3D_VOXEL_M, max_nn=30))
    features = TOOLS.compute_fpfh_feature(cloud, near(radius=5 * OPEN3D_VOXEL_M, max_nn=100))
    return FpfhScan(np.asarray(cloud.points), np.asarray(features.data))


def align_ransac(source: FpfhScan, target: FpfhScan) -> Estimate | Rejected:
    """Open3D's RANSAC over mutual FPFH matches."""
    open3d.utility.random.seed(SEED)
    reach_m = 1.5 * OPEN3D_VOXEL_M
    found = TOOLS.registration_ransac_based_on_feature_matching(
        *_clouds_and_features(source, target),
        mutual_filter=True,
        max_correspondence_distance=reach_m,
        estimation_method=TOOLS.TransformationEstimationPointToPoint(False),
        ransac_n=3,
        checkers=[
            TOOLS.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            TOOLS.CorrespondenceCheckerBasedOnDistance(reach_m),
        ],
        criteria=TOOLS.RANSACConvergenceCriteria(RANSAC_ITERATIONS, RANSAC_CONFIDENCE),
    )
    return _open3d_outcome(found)


def align_fgr(source: FpfhScan, target: FpfhScan) -> Estimate | Rejected:
    """Open3D's fast global registration (Zhou et al., ECCV 2016)."""
    open3d.utility.random.seed(SEED)
    found = TOOLS.registration_fgr_based_on_feature_matching(
        *_clouds_and_features(source, target),
        TOOLS.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * OPEN3D_VOXEL_M),
    )
    return _open3d_outcome(found)


def _open3d_outcome(found: Any) -> Estimate | Rejected:
    num_inliers = len(found.correspondence_set)
    if num_inliers == 0:
        return Rejected(RejectReason.TOO_FEW_INLIERS, "no consistent point pairs")
    return Estimate(np.array(found.transformation), num_inliers=num_inliers)


def _cloud(points: Points) -> open3d.geometry.PointCloud:
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))


def _clouds_and_features(source: FpfhScan, target: FpfhScan) -> list[Any]:
    """Arguments of Open3D's functions: both clouds, then both sets of features."""
    features = []
    for scan in (source, target):
        feature = TOOLS.Feature()
        feature.data = scan.features
        features.append(feature)
    return [_cloud(source.points), _cloud(target.points), *features]
