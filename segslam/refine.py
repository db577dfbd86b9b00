"""Coarse-to-fine alignment: GICP from a coarse pose, the search distance shrinking stage by stage.

The only importer of small_gicp. Its tangents are [rotation; translation] with the perturbation on the right, as ours.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import small_gicp

from segslam import geometry
from segslam.config import RefineConfig
from segslam.points import within_range
from segslam.types import Points, Registration, Rejected, RejectReason, Transform

NUM_NEIGHBOURS = 10
"""For the covariance of a point; small_gicp's default."""
NUM_THREADS = 2
"""For those covariances, each of which is made by itself: the bits are the same. Sums over pairs keep to one."""
STANDING_NORMAL_Z = math.cos(math.radians(45.0))
"""Chosen: what is steeper than this stands."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A scan made ready for alignment: thinned points with covariances, and their search tree."""

    cloud: Any
    tree: Any

    @property
    def points(self) -> Points:
        """(n, 3), in the scan's frame."""
        return self.cloud.points()[:, :3]

    @property
    def normals(self) -> Points:
        """(n, 3), of unit length."""
        return self.cloud.normals()[:, :3]

    @property
    def standing(self) -> Points:
        """(k, 3): those on surfaces steeper than 45 degrees, where the scan's z points up."""
        return self.points[np.abs(self.cloud.normals()[:, 2]) < STANDING_NORMAL_Z]

    def __len__(self) -> int:
        return self.cloud.size()

    def nearest(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each: row of the point of the surface that is nearest to a point of this frame, and how far it is."""
        rows, squared = self.tree.batch_nearest_neighbor_search(points, num_threads=1)
        return np.asarray(rows), np.sqrt(squared)

    def distances_m(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each: from points of this frame to the nearest point of the surface, and to the plane through it."""
        rows, to_point = self.nearest(points)
        to_plane = np.einsum("ij,ij->i", points - self.points[rows], self.normals[rows])
        return to_point, np.abs(to_plane)


def thin(points: Points, *, config: RefineConfig) -> Points:
    """What alignment needs of a scan: one mean point a voxel within `max_range_m`, float32; some 100 KB."""
    near = points.compress(within_range(points, 0.0, config.max_range_m), axis=0).astype(np.float64)
    return small_gicp.voxelgrid_sampling(near, config.voxel_m, 1).points()[:, :3].astype(np.float32)


def prepare(thinned: Points, *, config: RefineConfig) -> Surface:
    """The surface through points that `thin` left. May hold none; `refine` then rejects."""
    cloud = small_gicp.PointCloud(thinned.astype(np.float64))
    tree = small_gicp.KdTree(cloud)
    if len(thinned) >= config.min_points:
        small_gicp.estimate_normals_covariances(cloud, tree, NUM_NEIGHBOURS, NUM_THREADS)
    return Surface(cloud, tree)


def refine(
    source: Surface, target: Surface, T_target_source: Transform, *, config: RefineConfig
) -> Registration | Rejected:
    """The pose near `T_target_source` that aligns the source with the target (GICP, Segal et al. 2009).

    `information` is the Hessian of the last stage, scaled, and bounded by the noise that all points share; `rms_m` is
    point to plane.
    Rejects TOO_FEW_POINTS, and REFINEMENT_DIVERGED where no pairs remain or the last stage does not converge.
    """
    if min(len(source), len(target)) < config.min_points:
        sizes = f"{len(source)} and {len(target)} points, {config.min_points} needed"
        return Rejected(RejectReason.TOO_FEW_POINTS, sizes)
    for correspondence_m in config.correspondence_m:
        result = small_gicp.align(
            target.cloud,
            source.cloud,
            target.tree,
            T_target_source,
            max_correspondence_distance=correspondence_m,
            max_iterations=config.max_iterations,
            num_threads=1,
        )
        T_target_source = result.T_target_source
        if result.num_inliers < config.min_points or not np.isfinite(T_target_source).all():
            return Rejected(RejectReason.REFINEMENT_DIVERGED, f"{result.num_inliers} pairs at {correspondence_m} m")
    to_point, to_plane = target.distances_m(geometry.apply(T_target_source, source.points))
    paired = to_plane[to_point < config.correspondence_m[-1]]
    return Registration(
        T_target_source=T_target_source,
        num_correspondences=len(source),
        num_inliers=int(result.num_inliers),
        rms_m=float(np.sqrt(np.mean(paired**2))),
        information=geometry.with_noise(
            (result.H + result.H.T) / 2 * config.information_scale,
            rotation_rad=math.radians(config.shared_noise_deg),
            translation_m=config.shared_noise_m,
        ),
    )
