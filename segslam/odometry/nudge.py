"""Gauss-Newton steps from a scan's points to the planes of earlier scans, with robust weights.

At the correct pose the steps are nearly zero. They take a few milliseconds, GICP tens.
"""

from collections.abc import Sequence

import numpy as np

from segslam.core import geometry
from segslam.core.kernels import kernel
from segslam.core.types import Points, Transform
from segslam.registration.refinement import PRECISION_M, LightSurface

NUM_POINTS, NUM_SEARCH = 1500, 400
"""Chosen: number of points. With all points the correction of KITTI's scans at 2 m changes by less than 5 mm; fewer are
enough to find where a search from afar ends."""
POLISH_VOXELS = (1.4, 1.4, 1.0, 1.0, 1.0)
"""Chosen: search distance of each step after GICP, in voxels of the points; to GICP every point has the same weight."""
SEARCH_VOXELS = (4.0, 3.0, 2.0, 2.0, 1.4, 1.4, 1.0, 1.0, 1.0, 1.0)
"""Chosen: the same from an initial guess."""
SCALE_VOXELS = 0.2
"""Scale of the Cauchy weights, in voxels; residuals of planar surfaces are half of it."""
LEAST_POINTS, LEAST_NEAR = 50, 30


def nudge(
    points: Points,
    target: LightSurface,
    T_target_source: Transform,
    *,
    voxel_m: float,
    reaches: Sequence[float],
    num_points: int = NUM_POINTS,
) -> Transform | None:
    """Point-to-plane correction of a pose, a step for each search distance; None if too few points are near the target.

    A step is left out if the last one, with the same distance, moved the points by less than `PRECISION_M`. `points`
    (n, 3) of the source, downsampled with `voxel_m`; `reaches`: search distances in voxels. Chen and Medioni 1992, with
    Cauchy weights: points on a vehicle that drives ahead have little weight.
    """
    if min(len(points), len(target.points)) < LEAST_POINTS:
        return None
    chosen = points[:: max(1, len(points) // num_points)].astype(np.float64)
    target_points, scale_m = target.points, SCALE_VOXELS * voxel_m
    T_now, before, reach_before = T_target_source, np.full_like(chosen, np.inf), 0.0
    for reach in reaches:
        moved = geometry.apply(T_now, chosen)
        if reach == reach_before and np.square(moved - before).sum(axis=1).mean() < PRECISION_M**2:
            continue
        before, reach_before = moved, reach
        rows, apart_m = target.nearest(moved)
        near = apart_m < reach * voxel_m
        if near.sum() < LEAST_NEAR:
            return None
        rows = rows[near]
        hessian, gradient = _normal_equations(moved[near], target_points[rows], target.normals_at(rows), scale_m)
        damped = hessian + 1e-3 * np.diag(np.diag(hessian)) + 1e-9 * np.eye(6)
        T_now = geometry.exp(-np.linalg.solve(damped, gradient)[:, 0]) @ T_now
    return geometry.nearest_transform(T_now)


@kernel("UniTuple(float64[:, ::1], 2)(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64)")
def _normal_equations(points, planes, normals, scale):
    """Hessian (6, 6) and gradient (6, 1) of half the weighted squares by the pose, perturbed from the left."""
    hessian, gradient, row = np.zeros((6, 6)), np.zeros((6, 1)), np.empty(6)
    for k in range(len(points)):
        p, n = points[k], normals[k]
        e = 0.0
        for i in range(3):
            e += n[i] * (p[i] - planes[k, i])
        row[0], row[1], row[2] = p[1] * n[2] - p[2] * n[1], p[2] * n[0] - p[0] * n[2], p[0] * n[1] - p[1] * n[0]
        row[3], row[4], row[5] = n[0], n[1], n[2]
        w = 1.0 / (1.0 + (e / scale) ** 2)
        for i in range(6):
            gradient[i, 0] += w * e * row[i]
            for j in range(i, 6):
                hessian[i, j] += w * row[i] * row[j]
    for i in range(6):
        for j in range(i):
            hessian[i, j] = hessian[j, i]
    return hessian, gradient
