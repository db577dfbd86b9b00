"""Likelihood of a scan at a pose in a map: how well its points fit the surfaces, and how sharply that fixes the pose.

Each point has the density of a mixture: an inlier with normally distributed distance to the nearest plane of the map,
or an outlier, uniform within the search distance. Points near each other share errors (moving objects, calibration,
shape of the surface). At the right pose, how much is learnt from the last scans, and the covariance is larger by this;
between wrong poses, points of a patch differ together, and a patch counts as one observation.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh

from segslam.core import geometry
from segslam.core.types import Information, Points, Transform, Vector
from segslam.odometry.nudge import NUM_POINTS
from segslam.registration.refinement import PRECISION_M, LightSurface

OUTLIER_SHARE = 0.1
"""Chosen: share of points without a counterpart in the map."""
REACH_VOXELS = 2.0
"""Derived: points of one surface, one in each voxel, are at most this many edges apart."""
LEAST_SIGMA_VOXELS = 0.1
"""Chosen: smallest standard deviation of an inlier; below it, means of voxels do not repeat between scans."""
PATCH_VOXELS = 3.0
"""Chosen: edge of the patches that count as one observation when poses are compared."""
CELLS_VOXELS = PATCH_VOXELS * 2.0 ** np.arange(5)
"""Edges of the cells in which errors are added up, doubled from a few points in a cell to a few cells in a scan: the
largest sum of all sizes counts."""
NORMAL_NOISE = 0.02
"""Chosen: mean squared cosine between the estimated normals of a smooth surface and a direction within it (8 degrees);
1/3 if normals have no preferred direction. Measured: at most 0.005 in a simulated tunnel without features, at least
0.063 in real scans."""
UNOBSERVED = 1e-12
"""Share of the constraint that is left in an unconstrained direction."""


class Errors(NamedTuple):
    """The errors of the points of a scan that are near the map."""

    at: Points
    """(n, 3) the nearest points of the map, in voxels: where the scan's own points are depends on their errors."""
    gradients: Float[np.ndarray, "_ 6"]
    """Of half the squared distances to the planes by the pose, weighted by the probability of an inlier."""

    def added_up(self) -> Vector:
        """For each of `CELLS_VOXELS`, mean square of the gradients added up in the cells, by that of single points.

        The covariance of an estimate by sums over clusters (Liang and Zeger 1986), here one factor for all directions.
        """
        alone = np.linalg.pinv(self.gradients.T @ self.gradients, hermitian=True)
        found = np.empty(len(CELLS_VOXELS))
        for number, edge in enumerate(CELLS_VOXELS):
            cells = np.floor(self.at / edge).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
            _, row = np.unique(cells, return_inverse=True)
            sums = np.column_stack([np.bincount(row, column) for column in self.gradients.T])
            found[number] = np.sum(alone * (sums.T @ sums)) / 6.0
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose of a scan in a map, and how well it explains the scan."""

    T_map_lidar: Transform
    mean_log: float
    """Mean log-likelihood of a point (nats; density per metre)."""
    num_patches: int
    """Number of independent observations: points beside each other fit a wrong pose together."""
    overlap: float
    """Share of the points within the search distance of the map."""
    rms_m: float
    """Root mean square distance of these points to the planes; 0 without any."""
    information: Information
    """Of the pose, by the distances of the points to the planes and their correlation; tangent in the scan's frame."""
    errors: Errors
    log_prior: float = 0.0
    """Log of the probability of the motion to this pose; 0 if nothing is known of it."""
    log_odds: float | None = None
    """That the pose is right, by the score of loops (nats); None if there is no other to compare it with."""

    @property
    def log_likelihood(self) -> float:
        """Of the scan: the mean of n patches, which fluctuates by 1 / sqrt(n), in standard deviations.

        Spacings of order statistics are exponentially distributed (Renyi 1953): with the probability exp(-d) that
        poses which are both wrong differ by d. Measured on scans of NCLT in maps of other places: 95 % of the
        differences of the mean are below 0.14 where this expects 0.135.
        """
        return self.mean_log * math.sqrt(self.num_patches)


class Correlation:
    """How much the errors of a scan's points have in common, learnt from the last scans."""

    def __init__(self, num_scans: int) -> None:
        """Learnt from so many scans."""
        self._added_up: deque[Vector] = deque(maxlen=num_scans)

    def note(self, fit: Fit) -> None:
        """Learn from a scan at its most likely pose."""
        self._added_up.append(fit.errors.added_up())

    def factor(self, errors: Errors) -> float:
        """By what factor the squared error of a pose is larger than if the points erred independently.

        The largest of all sizes of cells: errors in common over short distances add up in all larger cells, those over
        long ones in these alone; and those in the largest ones cancel, because the pose is the best one. `errors` of
        the scan itself, which count until another one is known.
        """
        return max(1.0, float(np.mean(self._added_up or [errors.added_up()], axis=0).max()))


def fit(
    points: Points,
    target: LightSurface,
    T_target_source: Transform,
    correlation: Correlation,
    *,
    voxel_m: float,
    sigma_m: float = 0.0,
) -> Fit:
    """Fit of `NUM_POINTS` of the downsampled points (n, 3) to a surface with one point in each voxel, at a pose.

    `sigma_m`: roughness of the surface, if known; at least `LEAST_SIGMA_VOXELS` is used.
    """
    source = points[:: max(1, len(points) // NUM_POINTS)].astype(np.float64)
    reach_m, sigma_m = REACH_VOXELS * voxel_m, max(sigma_m, LEAST_SIGMA_VOXELS * voxel_m)
    moved = geometry.apply(T_target_source, source)
    rows, apart_m = target.nearest(moved)
    near = np.flatnonzero(apart_m < reach_m)
    normals = target.normals_at(rows[near])
    to_plane = np.einsum("ij,ij->i", moved[near] - target.points[rows[near]], normals)
    inlier = (1.0 - OUTLIER_SHARE) / (math.sqrt(2.0 * math.pi) * sigma_m) * np.exp(-0.5 * (to_plane / sigma_m) ** 2)
    outlier = OUTLIER_SHARE / (2.0 * reach_m)
    total_log = float(np.log(inlier + outlier).sum()) + (len(source) - len(near)) * math.log(outlier)
    is_inlier = inlier / (inlier + outlier)
    variance = max(float(is_inlier @ to_plane**2) / max(float(is_inlier.sum()), 1e-9), PRECISION_M**2)
    normals_source = normals @ T_target_source[:3, :3]
    along = np.column_stack([np.cross(source[near], normals_source), normals_source])
    errors = Errors(target.points[rows[near]] / voxel_m, along * (is_inlier * to_plane)[:, None])
    cells = np.floor(points / (PATCH_VOXELS * voxel_m)).astype(np.int64)
    num_patches = len(np.unique(cells @ np.array([1, 1 << 20, 1 << 40])))
    return Fit(
        T_target_source,
        total_log / max(len(source), 1),
        num_patches,
        len(near) / max(len(source), 1),
        float(np.sqrt(np.mean(to_plane**2))) if len(near) else 0.0,
        _curvature(source[near], along, is_inlier / (variance * correlation.factor(errors))),
        errors,
    )


def _curvature(points: Points, along: np.ndarray, weights: Vector) -> Information:
    """Gauss-Newton information of points (n, 3), of which (n, 6) tangents change the distance to the plane.

    Both are in the source's frame; that of noise in the normals is left out.

    In every direction of the tangent, the constraint is compared with that of points without preferred normals. The
    share that noise in the normals explains is subtracted.
    """
    hessian = (along * weights[:, None]).T @ along
    isotropic = _of_points(points, weights) + 1e-9 * (1.0 + weights.sum()) * np.eye(6)  # else singular
    shares, directions = eigh(hessian, isotropic)
    kept = np.maximum(shares - NORMAL_NOISE, UNOBSERVED)
    half = isotropic @ directions
    return (half * kept) @ half.T


def _of_points(points: Points, weights: Vector) -> Information:
    """Curvature of half the weighted squares of the displacements of points, tangent in their frame."""
    moment, second = weights @ points, (points * weights[:, None]).T @ points
    skew = np.cross(np.eye(3), moment)
    return np.block([[np.trace(second) * np.eye(3) - second, skew], [-skew, weights.sum() * np.eye(3)]])
