"""Gauss-Newton steps from a scan's points to the planes of earlier scans, with robust weights.

At the correct pose the steps are nearly zero. They take a few milliseconds, GICP tens.
"""

from collections.abc import Sequence

import numpy as np

from segslam import geometry
from segslam.refinement import LightSurface, Surface
from segslam.types import Points, Transform

NUM_POINTS, NUM_SEARCH = 1500, 400
"""Chosen: number of points. With all points the correction of KITTI's scans at 2 m changes by less than 5 mm; fewer are
enough to find where a search from afar ends."""
CHECK_VOXELS = (2.0, 2.0, 1.0)
"""Search distance of each step of a check, in voxels of the points."""
POLISH_VOXELS = (1.4, 1.4, 1.0, 1.0, 1.0)
"""Chosen: the same after GICP, to which every point has the same weight."""
SEARCH_VOXELS = (4.0, 3.0, 2.0, 2.0, 1.4, 1.4, 1.0, 1.0, 1.0, 1.0)
"""Chosen: the same from an initial guess."""
SCALE_VOXELS = 0.2
"""Scale of the Cauchy weights, in voxels; residuals of planar surfaces are half of it."""
LEAST_POINTS, LEAST_NEAR = 50, 30


def nudge(
    points: Points,
    target: Surface | LightSurface,
    T_target_source: Transform,
    *,
    voxel_m: float,
    reaches: Sequence[float],
    num_points: int = NUM_POINTS,
) -> Transform | None:
    """Point-to-plane correction of a pose, a step for each search distance; None if too few points are near the target.

    `points` (n, 3) of the source, downsampled with `voxel_m`; `reaches`: search distances in voxels. Chen and Medioni
    1992, with Cauchy weights: points on a vehicle that drives ahead have little weight.
    """
    if min(len(points), len(target.points)) < LEAST_POINTS:
        return None
    chosen = points[:: max(1, len(points) // num_points)].astype(np.float64)
    T_now = T_target_source
    for reach in reaches:
        moved = geometry.apply(T_now, chosen)
        rows, apart_m = target.nearest(moved)
        near = apart_m < reach * voxel_m
        if near.sum() < LEAST_NEAR:
            return None
        normal, point = target.normals_at(rows[near]), moved[near]
        residual = np.einsum("ij,ij->i", point - target.points[rows[near]], normal)
        weight = 1.0 / (1.0 + (residual / (SCALE_VOXELS * voxel_m)) ** 2)
        jacobian = np.hstack([np.cross(point, normal), normal])
        hessian = (jacobian * weight[:, None]).T @ jacobian
        gradient = (jacobian * weight[:, None]).T @ residual
        damped = hessian + 1e-3 * np.diag(np.diag(hessian)) + 1e-9 * np.eye(6)
        T_now = geometry.exp(-np.linalg.solve(damped, gradient)) @ T_now
    return geometry.nearest_transform(T_now)
