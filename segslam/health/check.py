"""A fast check of a motion: a few Gauss-Newton steps from a scan's points to the planes of an earlier scan.

At the correct pose the steps are nearly zero. The check takes a few milliseconds, a full registration tens.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from segslam import geometry
from segslam.refinement import LightSurface, Surface
from segslam.types import Direction, Points, Transform

NUM_POINTS = 1500
"""Chosen: the correction of KITTI's scans at 2 m changes by less than 5 mm with all points."""
REACHES_M = (1.0, 1.0, 0.5)
"""Search distance of each step of a check (m)."""
POLISH_M = (0.7, 0.7, 0.5, 0.5, 0.5)
"""Chosen: the same after GICP, to which every point has the same weight."""
SEARCH_M = (2.0, 1.5, 1.0, 1.0, 0.7, 0.7, 0.5, 0.5, 0.5, 0.5)
"""Chosen: the same from an initial guess."""
RESIDUAL_SCALE_M = 0.1
"""Scale of the Cauchy weights; residuals of planar surfaces in voxels of 0.5 m are half of it."""
NUM_NORMALS = 1000
"""Chosen: with the normals of all points the smallest share changes by 5 % at most (KITTI 00, NCLT, courtyard)."""
LEAST_CONSTRAINT = 0.02
"""Chosen: smallest mean squared cosine between a direction and the normals of a scan; 1/3 if all directions are equal.
Measured: at least 0.109 in KITTI's scans, 0.063 in NCLT's, 0.166 in the courtyard's; 0.058 in a simulated tunnel with
niches, at most 0.005 in one without features."""


@dataclass(frozen=True, slots=True)
class Nudge:
    """Result of the Gauss-Newton steps."""

    T_target_source: Transform
    overlap: float
    """Share of the points within the last search distance of the target, at the final pose."""
    moved_m: float
    moved_rad: float


def nudge(
    points: Points,
    target: LightSurface | Surface,
    T_target_source: Transform,
    *,
    reaches_m: Sequence[float] = REACHES_M,
) -> Nudge | None:
    """Point-to-plane correction of a pose, a step for each search distance; None if too few points are near the target.

    `points` (n, 3) of the source, downsampled. Chen and Medioni 1992, with Cauchy weights: points on a vehicle that
    drives ahead have little weight.
    """
    if len(points) < 50 or len(target) < 50:
        return None
    chosen = points[:: max(1, len(points) // NUM_POINTS)].astype(np.float64)
    T_now = T_target_source
    overlap = 0.0
    for reach_m in reaches_m:
        moved = geometry.apply(T_now, chosen)
        rows, apart_m = target.nearest(moved)
        near = apart_m < reach_m
        overlap = float(near.mean())
        if near.sum() < 30:
            return None
        normal, point = target.normals_at(rows[near]), moved[near]
        residual = np.einsum("ij,ij->i", point - target.points[rows[near]], normal)
        weight = 1.0 / (1.0 + (residual / RESIDUAL_SCALE_M) ** 2)
        jacobian = np.hstack([np.cross(point, normal), normal])
        hessian = (jacobian * weight[:, None]).T @ jacobian
        gradient = (jacobian * weight[:, None]).T @ residual
        damped = hessian + 1e-3 * np.diag(np.diag(hessian)) + 1e-9 * np.eye(6)
        T_now = geometry.exp(-np.linalg.solve(damped, gradient)) @ T_now
    T_before_after = geometry.inverse(T_target_source) @ T_now
    moved_m, moved_rad = geometry.distance(T_before_after), geometry.angle(T_before_after)
    return Nudge(T_now, overlap, moved_m, moved_rad)


def open_direction(scan: LightSurface) -> Direction | None:
    """Direction (unit length, scan frame) in which the surfaces of a scan do not constrain motion, or None.

    It is the direction of the smallest eigenvalue of the mean of n n^T over the normals n of some points.
    """
    normals = scan.normals_at(np.arange(0, len(scan), max(1, len(scan) // NUM_NORMALS)))
    shares, directions = np.linalg.eigh(normals.T @ normals / len(normals))
    return directions[:, 0] if shares[0] < LEAST_CONSTRAINT else None
