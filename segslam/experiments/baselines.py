"""Registration methods of other libraries, each with the settings that its authors give for LiDAR scans.

`prepare_*` makes of one scan's points what can be made once; `align_*` aligns two scans so prepared. All on one thread
where the library lets it choose.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
import small_gicp

from segslam import geometry
from segslam.experiments.estimate import Estimate
from segslam.types import Points, Rejected, RejectReason

GICP_VOXEL_M = 0.25
GICP_DISTANCE_M = 1.0
VGICP_VOXEL_M = 1.0
GICP_NEIGHBOURS = 10
"""small_gicp's defaults (Koide, JOSS 2024), for outdoor LiDAR."""
GICP_ITERATIONS = 64
"""Of its author's fast_gicp, which the paper ran. small_gicp's 20 stop two of three pairs 4 m apart on their way."""
KISS_MIN_POINTS = 100
"""Chosen: KISS-Matcher 1.0.2 ends the process at a dozen points."""
KISS_VOXEL_M = 0.3
"""KISS-Matcher's own voxel for outdoor scans (Lim et al., ICRA 2025)."""
OPEN3D_VOXEL_M = 0.5
"""Chosen: the voxel of Segregator's authors for FPFH. All else is in voxels, as in Open3D's own examples."""
TOOLS: Any = open3d.pipelines.registration
RANSAC_ITERATIONS, RANSAC_CONFIDENCE = 100_000, 0.999
SEED = 0


class GicpScan:
    """A thinned cloud with covariances, its search tree and its voxel map. Travels between processes as its points."""

    def __init__(self, thinned: Points) -> None:
        self.cloud = small_gicp.PointCloud(thinned)
        self.tree = small_gicp.KdTree(self.cloud)
        small_gicp.estimate_normals_covariances(self.cloud, self.tree, GICP_NEIGHBOURS, 1)
        self.voxels = small_gicp.GaussianVoxelMap(VGICP_VOXEL_M)
        self.voxels.insert(self.cloud)

    def __reduce__(self) -> tuple[Any, ...]:
        return GicpScan, (self.cloud.points()[:, :3],)


@dataclass(frozen=True, slots=True, eq=False)
class FpfhScan:
    """Voxel means with their FPFH, (33, n)."""

    points: Points
    features: np.ndarray


def prepare_gicp(points: Points) -> GicpScan:
    """small_gicp's preprocessing."""
    return GicpScan(small_gicp.voxelgrid_sampling(points.astype(np.float64), GICP_VOXEL_M, 1).points()[:, :3])


def align_gicp(source: GicpScan, target: GicpScan) -> Estimate | Rejected:
    """GICP (Segal et al., RSS 2009) from the identity."""
    found = small_gicp.align(
        target.cloud,
        source.cloud,
        target.tree,
        max_correspondence_distance=GICP_DISTANCE_M,
        max_iterations=GICP_ITERATIONS,
    )
    return _small_gicp_outcome(found, source)


def align_vgicp(source: GicpScan, target: GicpScan) -> Estimate | Rejected:
    """Voxelised GICP (Koide et al., ICRA 2021) from the identity."""
    found = small_gicp.align(
        target.voxels, source.cloud, max_correspondence_distance=GICP_DISTANCE_M, max_iterations=GICP_ITERATIONS
    )
    return _small_gicp_outcome(found, source)


def prepare_points(points: Points) -> Points:
    """The points as they are, for a method that does all in one call."""
    return points.astype(np.float32)


def align_kiss_matcher(source: Points, target: Points) -> Estimate | Rejected:
    """KISS-Matcher on the whole scans, the ground included."""
    import kiss_matcher  # optional: extra `bench`

    if min(len(source), len(target)) < KISS_MIN_POINTS:
        return Rejected(RejectReason.TOO_FEW_POINTS, f"{len(source)} and {len(target)} points")
    found = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(KISS_VOXEL_M))
    pose = found.estimate(source, target)
    if not pose.valid:
        return Rejected(RejectReason.TOO_FEW_INLIERS, f"{found.get_num_final_inliers()} inliers")
    return Estimate(
        geometry.transform(np.array(pose.rotation), np.array(pose.translation).ravel()),
        num_correspondences=len(found.get_initial_correspondences()),
        num_inliers=found.get_num_final_inliers(),
    )


def prepare_fpfh(points: Points) -> FpfhScan:
    """Open3D's FPFH of the voxelised scan."""
    near = open3d.geometry.KDTreeSearchParamHybrid
    cloud = _cloud(points).voxel_down_sample(OPEN3D_VOXEL_M)
    cloud.estimate_normals(near(radius=2 * OPEN3D_VOXEL_M, max_nn=30))
    features = TOOLS.compute_fpfh_feature(cloud, near(radius=5 * OPEN3D_VOXEL_M, max_nn=100))
    return FpfhScan(np.asarray(cloud.points), np.asarray(features.data))


def align_ransac(source: FpfhScan, target: FpfhScan) -> Estimate | Rejected:
    """RANSAC over mutual FPFH matches, Open3D's."""
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
    """Fast global registration (Zhou et al., ECCV 2016), Open3D's."""
    open3d.utility.random.seed(SEED)
    found = TOOLS.registration_fgr_based_on_feature_matching(
        *_clouds_and_features(source, target),
        TOOLS.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * OPEN3D_VOXEL_M),
    )
    return _open3d_outcome(found)


def _small_gicp_outcome(found: Any, source: GicpScan) -> Estimate | Rejected:
    if found.num_inliers == 0:
        return Rejected(RejectReason.REFINEMENT_DIVERGED, "no pairs of points")
    return Estimate(found.T_target_source, num_correspondences=source.cloud.size(), num_inliers=int(found.num_inliers))


def _open3d_outcome(found: Any) -> Estimate | Rejected:
    num_inliers = len(found.correspondence_set)
    if num_inliers == 0:
        return Rejected(RejectReason.TOO_FEW_INLIERS, "no pair of points agrees")
    return Estimate(np.array(found.transformation), num_inliers=num_inliers)


def _cloud(points: Points) -> open3d.geometry.PointCloud:
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))


def _clouds_and_features(source: FpfhScan, target: FpfhScan) -> list[Any]:
    """As Open3D's functions take them: both clouds, then both sets of features."""
    features = []
    for scan in (source, target):
        feature = TOOLS.Feature()
        feature.data = scan.features
        features.append(feature)
    return [_cloud(source.points), _cloud(target.points), *features]
