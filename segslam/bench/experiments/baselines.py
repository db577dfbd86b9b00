"""Registration methods of other libraries, with the settings that their authors recommend for LiDAR scans.

`prepare_*` computes the data of one scan that can be reused; `align_*` aligns two prepared scans. Methods run on one
thread if the library allows it. Open3D is large, and imported on use.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import small_gicp

from segslam.core import geometry
from segslam.core.types import Points, Rejected, RejectReason, Transform

GICP_VOXEL_M = 0.25
GICP_DISTANCE_M = 1.0
VGICP_VOXEL_M = 1.0
GICP_NEIGHBOURS = 10
"""small_gicp's defaults (Koide, JOSS 2024), for outdoor LiDAR."""
GICP_ITERATIONS = 64
"""Value of fast_gicp, used in the paper. With small_gicp's 20, two of three pairs 4 m apart do not converge."""
KISS_MIN_POINTS = 100
"""Chosen: KISS-Matcher 1.0.2 terminates the process with about a dozen points."""
KISS_VOXEL_M = 0.3
"""Voxel size that KISS-Matcher's authors use outdoors (Lim et al., ICRA 2025)."""
OPEN3D_VOXEL_M = 0.5
"""Chosen: voxel size of Segregator's authors for FPFH. Other lengths are multiples of it, as in Open3D's examples."""
RANSAC_ITERATIONS, RANSAC_CONFIDENCE = 100_000, 0.999


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The pose of the source in the target, and figures of the method; None for figures that it does not have."""

    T_target_source: Transform
    num_correspondences: int | None = None
    num_inliers: int | None = None
    num_edges: int | None = None
    """Number of edges of the consistency graph."""
    overlap: float | None = None
    """As that of `segslam.core.types.Alignment`, and the next two."""
    probability: float | None = None
    evidence: dict[str, float] | None = None


class GicpScan:
    """A downsampled cloud with covariances, search tree and voxel map. It is pickled as its points."""

    def __init__(self, downsampled: Points) -> None:
        self.cloud = small_gicp.PointCloud(downsampled)
        self.tree = small_gicp.KdTree(self.cloud)
        small_gicp.estimate_normals_covariances(self.cloud, self.tree, GICP_NEIGHBOURS, 1)
        self.voxels = small_gicp.GaussianVoxelMap(VGICP_VOXEL_M)
        self.voxels.insert(self.cloud)

    def __reduce__(self) -> tuple[Any, ...]:
        return GicpScan, (self.cloud.points()[:, :3],)


def prepare_gicp(points: Points) -> GicpScan:
    """Preprocessing of small_gicp."""
    return GicpScan(small_gicp.voxelgrid_sampling(points.astype(np.float64), GICP_VOXEL_M, 1).points()[:, :3])


def align_gicp(source: GicpScan, target: GicpScan) -> Estimate | Rejected:
    """GICP (Segal et al., RSS 2009) from the identity."""
    return _align(source, target.cloud, target.tree)


def align_vgicp(source: GicpScan, target: GicpScan) -> Estimate | Rejected:
    """Voxelised GICP (Koide et al., ICRA 2021) from the identity."""
    return _align(source, target.voxels)


def _align(source: GicpScan, *target: Any) -> Estimate | Rejected:
    """small_gicp's alignment with a voxel map, or with a cloud and its search tree."""
    found = small_gicp.align(
        target[0],
        source.cloud,
        *target[1:],
        max_correspondence_distance=GICP_DISTANCE_M,
        max_iterations=GICP_ITERATIONS,
    )
    if found.num_inliers == 0:
        return Rejected(RejectReason.REFINEMENT_DIVERGED, "no point pairs")
    return Estimate(found.T_target_source, num_correspondences=source.cloud.size(), num_inliers=int(found.num_inliers))


def align_kiss_matcher(source: Points, target: Points) -> Estimate | Rejected:
    """KISS-Matcher on the whole scans, including the ground."""
    import kiss_matcher  # optional package: extra `bench`

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


FpfhScan = tuple[Points, np.ndarray]
"""Voxel means (n, 3) with their FPFH, (33, n)."""


def prepare_fpfh(points: Points) -> FpfhScan:
    """Open3D's FPFH of the voxelised scan."""
    import open3d

    tools: Any = open3d.pipelines.registration
    near = open3d.geometry.KDTreeSearchParamHybrid
    cloud = _cloud(points).voxel_down_sample(OPEN3D_VOXEL_M)
    cloud.estimate_normals(near(radius=2 * OPEN3D_VOXEL_M, max_nn=30))
    features = tools.compute_fpfh_feature(cloud, near(radius=5 * OPEN3D_VOXEL_M, max_nn=100))
    return np.asarray(cloud.points), np.asarray(features.data)


def align_ransac(source: FpfhScan, target: FpfhScan) -> Estimate | Rejected:
    """Open3D's RANSAC over mutual FPFH matches."""
    import open3d

    tools: Any = open3d.pipelines.registration
    reach_m = 1.5 * OPEN3D_VOXEL_M
    return _align_features(
        tools.registration_ransac_based_on_feature_matching,
        source,
        target,
        mutual_filter=True,
        max_correspondence_distance=reach_m,
        estimation_method=tools.TransformationEstimationPointToPoint(False),
        ransac_n=3,
        checkers=[
            tools.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            tools.CorrespondenceCheckerBasedOnDistance(reach_m),
        ],
        criteria=tools.RANSACConvergenceCriteria(RANSAC_ITERATIONS, RANSAC_CONFIDENCE),
    )


def align_fgr(source: FpfhScan, target: FpfhScan) -> Estimate | Rejected:
    """Open3D's fast global registration (Zhou et al., ECCV 2016)."""
    import open3d

    tools: Any = open3d.pipelines.registration
    option = tools.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * OPEN3D_VOXEL_M)
    return _align_features(tools.registration_fgr_based_on_feature_matching, source, target, option=option)


def _align_features(align: Any, source: FpfhScan, target: FpfhScan, **settings: Any) -> Estimate | Rejected:
    """The outcome of a function of Open3D that takes both clouds, both sets of features, and settings."""
    import open3d

    open3d.utility.random.seed(0)
    features = [open3d.pipelines.registration.Feature() for _ in range(2)]
    for feature, (_, values) in zip(features, (source, target), strict=True):
        feature.data = values
    found = align(_cloud(source[0]), _cloud(target[0]), *features, **settings)
    num_inliers = len(found.correspondence_set)
    if num_inliers == 0:
        return Rejected(RejectReason.TOO_FEW_INLIERS, "no consistent point pairs")
    return Estimate(np.array(found.transformation), num_inliers=num_inliers)


def _cloud(points: Points) -> Any:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
