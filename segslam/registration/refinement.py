"""Coarse-to-fine GICP from a coarse pose; the search distance decreases from stage to stage.

Besides the benchmarks in `experiments`, no other module imports small_gicp. Its tangents, like ours, are [rotation;
translation] with the perturbation on the right.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import small_gicp

from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.points import patch_normals, voxel_means
from segslam.core.types import (
    Direction,
    Indices,
    Information,
    Points,
    Registration,
    Rejected,
    RejectReason,
    Rotation,
    Transform,
)

MAX_ITERATIONS = 20
"""As small_gicp: largest number of iterations in each stage."""
MAX_RANGE_M = 60.0
"""Chosen: points farther away are dropped (m)."""
PRECISION_M = 0.001
"""As small_gicp: a stage has converged if an iteration moves the pose by less."""
MIN_POINTS = 100
"""Chosen on KITTI 00: smallest number of points, and of point pairs, for a registration."""
INFORMATION_SCALE = 0.05
"""Measured (simulated truth): factor from the Hessian to the information matrix; below 1: errors of neighbours are
correlated."""
SHARED_NOISE_M = 0.026
"""Measured (simulated truth): translation noise common to all points, for example from sensor calibration (m)."""
SHARED_NOISE_DEG = 0.067
"""Measured (simulated truth): rotation noise common to all points (degrees)."""
SHARED_NOISE = np.diag(geometry.tangent(rotation_rad=math.radians(SHARED_NOISE_DEG), translation_m=SHARED_NOISE_M) ** 2)
"""Covariance of the errors that all points of a scan have in common."""

NUM_NEIGHBOURS = 10
"""Number of neighbours for the covariance of a point; small_gicp's default."""
STANDING_NORMAL_Z = math.cos(math.radians(45.0))
"""Chosen: points on steeper surfaces are above ground (`standing`)."""
ROUGHNESS_REACH, LEAST_ROUGHNESS = 1.6, 0.02
"""Chosen, in voxels: farther neighbours are on other surfaces; a roughness below the second value is rounding."""
SETTLED_M, SETTLED_RAD = 0.02, math.radians(0.1)
"""Chosen: one in ten sparse scans oscillates by less between two sets of pairs."""
SAME_POSE_M, SAME_POSE_RAD = 0.75, math.radians(5.0)
"""Chosen: poses this near to each other are the same, and refinements from them end at one."""
SPARSE_VOXELS, LEAST_SPARSE = 3.0, 500
"""Chosen: edge of the voxels of a sparse surface, in `voxel_m`, and the points that it has at least."""
NUM_APPROACH = 5
"""Chosen: iterations after which a pose that leads to no good fit can be recognised."""
UNOBSERVED = 0.01
"""Chosen: a ratio of variances below this means unobserved; a smooth tunnel has 0.001, from GICP's tangents."""


class Surface:
    """A scan prepared for GICP: downsampled points with covariances, and their search tree.

    It may be empty; `refine` then rejects. It is pickled as its points.
    """

    def __init__(self, downsampled: Points, config: RefineConfig) -> None:
        self._config = config
        self.cloud = small_gicp.PointCloud(downsampled.astype(np.float64))
        self.tree = _tree_of(self.cloud)
        self.roughness_m = LEAST_ROUGHNESS * config.voxel_m
        """Root mean square distance of standing points to the plane through the nearest other point: the residual due
        to noise and shape within one scan at this voxel size."""
        if len(downsampled) >= MIN_POINTS:
            small_gicp.estimate_normals_covariances(self.cloud, self.tree, NUM_NEIGHBOURS, 1)
            self.roughness_m = max(_roughness_m(self, np.arange(len(self)), config.voxel_m), self.roughness_m)

    def __reduce__(self) -> tuple[Any, ...]:
        return Surface, (self.points.astype(np.float32), self._config)

    @property
    def points(self) -> Points:
        """(n, 3), in the scan's frame."""
        return self.cloud.points()[:, :3]

    @property
    def normals(self) -> Points:
        """(n, 3), of unit length; zero of fewer than `MIN_POINTS` points, which small_gicp leaves unset."""
        return self.cloud.normals()[:, :3] if len(self) >= MIN_POINTS else np.zeros((len(self), 3))

    def standing(self) -> tuple[Points, Points]:
        """(k, 3) points on surfaces steeper than 45 degrees, and their unit normals; the scan's z points up."""
        normals = self.normals
        stands = np.abs(normals[:, 2]) < STANDING_NORMAL_Z
        return self.points[stands], normals[stands]

    def __len__(self) -> int:
        return self.cloud.size()

    def nearest(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each: row of the nearest point of the surface, and the distance to it (m)."""
        rows, squared = self.tree.batch_nearest_neighbor_search(points, num_threads=1)
        return np.asarray(rows, dtype=np.int64), np.sqrt(squared)

    def normals_at(self, rows: Indices) -> Points:
        """(k, 3) normals of points by row."""
        return self.normals[rows]

    def distances_m(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each: distances of points to the nearest point of the surface, and to the plane through it (m)."""
        rows, to_point = self.nearest(points)
        to_plane = np.einsum("ij,ij->i", points - self.points[rows], self.normals[rows])
        return to_point, np.abs(to_plane)

    def sparse(self) -> "Surface":
        """A surface with fewer points, whose refinement is near that of all points in a quarter of the time.

        It is the surface itself where too few points would remain.
        """
        sampled = small_gicp.voxelgrid_sampling(self.points, SPARSE_VOXELS * self._config.voxel_m, 1)
        return Surface(sampled.points()[:, :3], self._config) if sampled.size() >= LEAST_SPARSE else self


class LightSurface:
    """Downsampled points (n, 3) with their search tree; normals are computed for the requested points only.

    Enough for steps from points to planes (`nudge`); it takes a third of the time of a `Surface`.
    """

    def __init__(self, thinned: Points) -> None:
        self.points = np.ascontiguousarray(thinned, dtype=np.float64)
        self.tree = _tree_of(self.points)
        self._normals = np.zeros_like(self.points)
        self._has_normal = np.zeros(len(thinned), dtype=bool)

    def __len__(self) -> int:
        return len(self.points)

    def nearest(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """As `Surface.nearest`."""
        rows, squared = self.tree.batch_nearest_neighbor_search(points, num_threads=1)
        return np.asarray(rows, dtype=np.int64), np.sqrt(squared)

    def normals_at(self, rows: Indices) -> Points:
        """(k, 3) normals of points by row, as those of a `Surface` but for the sign; zero where there is none."""
        is_new = np.zeros(len(self), dtype=bool)
        is_new[rows] = True
        new = np.flatnonzero(is_new & ~self._has_normal)
        if len(new):
            patches, _ = self.tree.batch_knn_search(self.points[new], NUM_NEIGHBOURS, num_threads=1)
            self._normals[new] = patch_normals(self.points, np.ascontiguousarray(patches, dtype=np.int64))
            self._has_normal[new] = True
        return self._normals[rows]

    def roughness_m(self, voxel_m: float, num_points: int) -> float:
        """As that of a `Surface`, of about `num_points` of the points, which are downsampled with `voxel_m`."""
        rows = np.arange(0, len(self), max(1, len(self) // num_points))
        return max(_roughness_m(self, rows, voxel_m), LEAST_ROUGHNESS * voxel_m)


def _roughness_m(surface: Surface | LightSurface, rows: Indices, voxel_m: float) -> float:
    """Of the standing points among these, which are downsampled with `voxel_m`; 0 without any."""
    standing = rows[np.abs(surface.normals_at(rows)[:, 2]) < STANDING_NORMAL_Z]
    if not len(standing):
        return 0.0
    nearest, squared = (
        np.asarray(found) for found in surface.tree.batch_knn_search(surface.points[standing], 2, num_threads=1)
    )
    near = squared[:, 1] < (ROUGHNESS_REACH * voxel_m) ** 2
    others = nearest[near, 1].astype(np.int64)
    to_plane = np.einsum(
        "ij,ij->i", surface.points[standing[near]] - surface.points[others], surface.normals_at(others)
    )
    return float(np.sqrt(np.mean(to_plane**2))) if len(others) else 0.0


def downsample(points: Points, *, config: RefineConfig) -> Points:
    """The mean point of each voxel within `max_range_m`, float32; about 100 KB per scan."""
    return voxel_means(points, config.voxel_m, beyond_m=0.0, within_m=MAX_RANGE_M).astype(np.float32)


def _tree_of(points: Any) -> Any:
    """The search tree of an array or cloud; None of no points: small_gicp warns, and a search ends the program."""
    return small_gicp.KdTree(points) if len(points) else None


def refine(
    source: Surface,
    target: Surface,
    T_target_source: Transform,
    *,
    config: RefineConfig,
    must_converge: bool = True,
    precision_m: float = PRECISION_M,
) -> Registration | Rejected:
    """The pose near `T_target_source` that aligns source and target by GICP (Segal et al. 2009).

    `information` is the scaled Hessian of the last stage, limited by the noise common to all points. In directions of
    translation that the points do not constrain, its standard deviation is the last search distance. `rms_m` is point
    to plane. Rejects TOO_FEW_POINTS, and REFINEMENT_DIVERGED if no pairs remain or, with `must_converge`, if the last
    stage does not converge and as many iterations again move the pose by more than `SETTLED_M` or `SETTLED_RAD`.
    """
    rejected = too_few_points(source, target)
    if rejected is not None:
        return rejected
    for correspondence_m in config.correspondence_m:
        result = _aligned(source, target, T_target_source, correspondence_m, MAX_ITERATIONS, precision_m)
        T_target_source = result.T_target_source
        if result.num_inliers < MIN_POINTS or not np.isfinite(T_target_source).all():
            return Rejected(RejectReason.REFINEMENT_DIVERGED, f"{result.num_inliers} pairs at {correspondence_m} m")
    if must_converge and not result.converged:
        result = _aligned(source, target, T_target_source, correspondence_m, MAX_ITERATIONS)
        moved = geometry.inverse(T_target_source) @ result.T_target_source
        T_target_source = result.T_target_source
        if not (geometry.distance(moved) < SETTLED_M and geometry.angle(moved) < SETTLED_RAD):
            detail = f"still moving after {MAX_ITERATIONS} iterations at {correspondence_m} m"
            return Rejected(RejectReason.REFINEMENT_DIVERGED, detail)
    to_point, to_plane = target.distances_m(geometry.apply(T_target_source, source.points))
    paired = to_plane[to_point < config.correspondence_m[-1]]
    return Registration(
        T_target_source=T_target_source,
        num_correspondences=len(source),
        num_inliers=int(result.num_inliers),
        rms_m=float(np.sqrt(np.mean(paired**2))),
        information=limited_information((result.H + result.H.T) / 2 * INFORMATION_SCALE, config=config),
    )


def too_few_points(source: Surface, target: Surface) -> Rejected | None:
    """TOO_FEW_POINTS for two surfaces that cannot be registered; None for all others."""
    if min(len(source), len(target)) >= MIN_POINTS:
        return None
    sizes = f"{len(source)} and {len(target)} points within {MAX_RANGE_M:g} m, {MIN_POINTS} needed"
    return Rejected(RejectReason.TOO_FEW_POINTS, sizes)


def is_near(T_target_source: Transform, T_target_others: Sequence[Transform]) -> bool:
    """True if a pose is the same as another of these."""
    apart = [geometry.inverse(other) @ T_target_source for other in T_target_others]
    return any(geometry.distance(one) < SAME_POSE_M and geometry.angle(one) < SAME_POSE_RAD for one in apart)


def approach(source: Surface, target: Surface, T_target_source: Transform, *, config: RefineConfig) -> Transform:
    """The pose after the first `NUM_APPROACH` iterations of `refine`; both surfaces have points."""
    begun = _aligned(source, target, T_target_source, config.correspondence_m[0], NUM_APPROACH)
    return begun.T_target_source


def _aligned(
    source: Surface,
    target: Surface,
    T_target_source: Transform,
    within_m: float,
    max_iterations: int,
    precision_m: float = PRECISION_M,
) -> Any:
    return small_gicp.align(
        target.cloud,
        source.cloud,
        target.tree,
        T_target_source,
        max_correspondence_distance=within_m,
        max_iterations=max_iterations,
        translation_epsilon=precision_m,
        num_threads=1,
    )


def observability(information: Information) -> tuple[float, Direction]:
    """Smallest divided by largest variance of the translation, and the direction of the largest variance.

    The ratio is 0 to 1, without the noise common to all points; 0 if the information is singular. The direction has
    unit length, in the source's frame: there the points constrain the pose least.
    """
    covariance = _covariance_of_translation(information)
    variances, directions = np.linalg.eigh(covariance - SHARED_NOISE_M**2 * np.eye(3))
    return float(max(variances[0], 0.0) / variances[2]), directions[:, 2]


def weakest_level(information: Information) -> Direction:
    """Level direction of the largest variance of the translation, of unit length, in the source's frame (z up).

    Heights are left out: places repeat along the ground, as the doors of a corridor do.
    """
    return np.array([*np.linalg.eigh(_covariance_of_translation(information)[:2, :2])[1][:, 1], 0.0])


def _covariance_of_translation(information: Information) -> Rotation:
    """(3, 3); of an unknown translation, all of it is along x."""
    try:
        return np.linalg.inv(information)[3:, 3:]
    except np.linalg.LinAlgError:
        return np.diag([1.0, 0.0, 0.0])


def limited_information(hessian: Information, *, config: RefineConfig) -> Information:
    """The information of a scaled Hessian with the noise common to all points.

    It has no spurious information along smooth surfaces.
    """
    information = geometry.with_covariance(hessian, SHARED_NOISE)
    ratio, direction = observability(information)
    if ratio >= UNOBSERVED:
        return information
    wide = np.zeros((6, 6))
    wide[3:, 3:] = config.correspondence_m[-1] ** 2 * np.outer(direction, direction)
    return geometry.with_covariance(information, wide)
