"""Pose from matched points with outliers: truncated least squares by graduated non-convexity.

Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020, Algorithm 1 with
the TLS surrogate, eq. (11)-(14). The inner fit is Horn's closed form (JOSA A 1987) in its SVD shape.
The decoupled solver is that of TEASER (Yang, Shi, Carlone, T-RO 2021), which Segregator's authors use.
`control` is mu of the paper, and `bound_m` its c bar.
"""

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.robust import CONTROL_FACTOR, first_control, tls_weights
from segslam.core.types import (
    Direction,
    Information,
    Points,
    Registration,
    Rejected,
    RejectReason,
    Rotation,
    Transform,
    Vector,
)

GNC_MAX_ITERATIONS = 100
"""Authors: largest number of iterations of GNC."""
GNC_COST_TOLERANCE = 1e-6
"""Authors: change of cost at which GNC stops."""

Fitted = TypeVar("Fitted")
AlignRotation = Callable[[Points, Points, Vector], Rotation]
"""The rotation R that minimises sum w |b - R a|^2 over rows a, b, w."""
Scored = tuple[float, Registration]
"""A pose and its score: the sum over its inliers, each between 1 (exact) and 0 (at the bound)."""


def solve_pose(source: Points, target: Points, *, bound_m: float, config: SegregatorConfig) -> Scored | Rejected:
    """The pose with the smallest truncated least-squares cost of matched points, by `config.solver`.

    Row i of `source` matches row i of `target`. Returns `Rejected(DEGENERATE)` if the points or the inliers are fewer
    than 3, or within the bound of a line (yaw only: fewer than 2, or within the bound of a vertical line).
    """
    align = rotation_between if config.rotation == "full" else yaw_between
    if not _fixes_rotation(source, bound_m, config):
        return _degenerate(len(source))
    solve = solve_decoupled if config.solver == "decoupled" else solve_joint
    T_target_source = solve(source, target, align, bound_m=bound_m)
    squared = _squared_distances(source, target, T_target_source)
    inliers = squared <= bound_m**2
    if not _fixes_rotation(source[inliers], bound_m, config):
        return _degenerate(int(inliers.sum()))
    squared = squared[inliers]
    return float(np.sum(1.0 - squared / bound_m**2)), Registration(
        T_target_source=T_target_source,
        num_correspondences=len(source),
        num_inliers=len(squared),
        rms_m=math.sqrt(squared.mean()),
        information=point_information(source[inliers], sigma_m=_axis_sigma(squared, bound_m)),
    )


def solve_joint(source: Points, target: Points, align: AlignRotation, *, bound_m: float) -> Transform:
    """Minimises sum min(|b - R a - t|^2, bound^2) over rotation and translation together."""

    def fit(weights: Vector) -> tuple[Transform, Vector]:
        T_target_source = weighted_pose(source, target, weights, align)
        return T_target_source, _squared_distances(source, target, T_target_source)

    return graduated_non_convexity(fit, len(source), bound_m=bound_m)


def solve_decoupled(source: Points, target: Points, align: AlignRotation, *, bound_m: float) -> Transform:
    """Rotation from the differences of rows that follow each other, then the translation, one axis at a time.

    The last row is followed by the first. A difference carries two measurements, hence twice the bound.
    """
    source_steps, target_steps = np.roll(source, -1, axis=0) - source, np.roll(target, -1, axis=0) - target

    def fit(weights: Vector) -> tuple[Rotation, Vector]:
        R = align(source_steps, target_steps, weights)
        return R, np.sum((target_steps - source_steps @ R.T) ** 2, axis=1)

    R = graduated_non_convexity(fit, len(source), bound_m=2 * bound_m)
    offsets = target - source @ R.T
    return geometry.transform(R, np.array([vote(axis, bound_m=bound_m) for axis in offsets.T]))


def solve_level(
    source: Points, target: Points, source_up: Direction, target_up: Direction, *, bound_m: float
) -> Transform | Rejected:
    """The pose that aligns the two verticals and minimises the truncated cost of the points projected to the ground.

    The height is the median height difference of the inliers. Unlike a full rotation, the result is unique for points
    on a line or on one level. Returns `Rejected(DEGENERATE)` for fewer than two distinct positions.
    """
    R_level_source, R_level_target = geometry.level(source_up), geometry.level(target_up)
    source_level, target_level = source @ R_level_source.T, target @ R_level_target.T
    source_plan, target_plan = source_level * [1.0, 1.0, 0.0], target_level * [1.0, 1.0, 0.0]
    T_plan = solve_joint(source_plan, target_plan, yaw_between, bound_m=bound_m)
    inliers = _squared_distances(source_plan, target_plan, T_plan) <= bound_m**2
    places = source_plan[inliers]
    if len(places) < 2 or np.linalg.norm(places - places.mean(axis=0), axis=1).max() <= bound_m:
        return _degenerate(len(places))
    height = np.median((target_level - source_level)[inliers, 2])
    T_level = geometry.transform(T_plan[:3, :3], T_plan[:3, 3] + [0.0, 0.0, height])
    return geometry.transform(R_level_target.T, 0.0) @ T_level @ geometry.transform(R_level_source, 0.0)


def graduated_non_convexity(fit: Callable[[Vector], tuple[Fitted, Vector]], num_rows: int, *, bound_m: float) -> Fitted:
    """The solution after the weights change gradually from 1 to those of truncated least squares.

    `fit` gives, for weights of the rows, the weighted least-squares solution and every row's squared residual.
    """
    weights = np.ones(num_rows)
    fitted, squared = fit(weights)
    control = first_control(squared.max(), bound_m**2)
    if control == 0.0:
        return fitted
    previous_cost = weights @ squared
    for _ in range(GNC_MAX_ITERATIONS):
        weights = tls_weights(squared, control, bound_m**2)
        if not weights.any():  # all rows became outliers: no consistent pose
            break
        fitted, squared = fit(weights)
        cost = weights @ squared
        if abs(cost - previous_cost) < GNC_COST_TOLERANCE:
            break
        previous_cost = cost
        control *= CONTROL_FACTOR
    return fitted


def weighted_pose(source: Points, target: Points, weights: Vector, align: AlignRotation) -> Transform:
    """Rotation by `align` about the weighted centroids, and the translation that aligns the centroids."""
    source_centre, target_centre = weights @ source / weights.sum(), weights @ target / weights.sum()
    R = align(source - source_centre, target - target_centre, weights)
    return geometry.transform(R, target_centre - R @ source_centre)


def rotation_between(source: Points, target: Points, weights: Vector) -> Rotation:
    """The rotation R that minimises sum w |b - R a|^2 over all rotations."""
    return geometry.nearest_rotation(target.T @ (weights[:, None] * source))


def yaw_between(source: Points, target: Points, weights: Vector) -> Rotation:
    """The same over rotations about z only."""
    x, y = source[:, 0], source[:, 1]
    cosine = weights @ (target[:, 0] * x + target[:, 1] * y)
    sine = weights @ (target[:, 1] * x - target[:, 0] * y)
    return geometry.yaw(math.atan2(sine, cosine))


def vote(values: Vector, *, bound_m: float) -> float:
    """Mean of the values within the bound of the centre with the smallest cost.

    Cost: squared residuals inside plus the bound for each value outside. That penalty is the bound and not its square,
    as in the authors' program, which favours many inliers over small residuals.
    """
    ends = np.sort(np.concatenate([values - bound_m, values + bound_m]))
    inside = np.abs(values - (ends[1:, None] + ends[:-1, None]) / 2) <= bound_m
    inside = inside[inside.any(axis=1)]
    means = inside @ values / inside.sum(axis=1)
    residuals = np.where(inside, (values - means[:, None]) ** 2, bound_m)
    return float(means[np.argmin(residuals.sum(axis=1))])


def _squared_distances(source: Points, target: Points, T_target_source: Transform) -> Vector:
    return np.sum((target - geometry.apply(T_target_source, source)) ** 2, axis=1)


def point_information(source: Points, *, sigma_m: float) -> Information:
    """Inverse covariance of a pose fitted to matched points with independent noise of `sigma_m` in each axis.

    For T exp(xi) the point a moves to R (a + phi x a + rho) + t, whose derivative is R [-[a]x, I]; R cancels.
    Errors common to all points, such as a bias of the labels, are not included.
    """
    columns = np.cross(np.eye(3), source[:, None, :])  # for each point, row k is e_k x a, a column of -[a]x
    jacobians = np.concatenate([np.swapaxes(columns, 1, 2), np.broadcast_to(np.eye(3), columns.shape)], axis=2)
    return np.einsum("nki,nkj->ij", jacobians, jacobians) / sigma_m**2


def _axis_sigma(squared: Vector, bound_m: float) -> float:
    """Standard deviation of one coordinate, from the squared residuals of a pose with six degrees of freedom.

    At least a third of the bound, because few points can have small residuals by chance.
    """
    return max(math.sqrt(squared.sum() / max(3 * len(squared) - 6, 1)), bound_m / 3.0)


def _fixes_rotation(points: Points, bound_m: float, config: SegregatorConfig) -> bool:
    """True if the root mean square distance of points from every line (yaw only: vertical line) exceeds the bound."""
    if len(points) < (3 if config.rotation == "full" else 2):
        return False
    centred = points - points.mean(axis=0)
    off_line = np.linalg.svd(centred, compute_uv=False)[1:] if config.rotation == "full" else centred[:, :2]
    return float(np.linalg.norm(off_line)) > bound_m * math.sqrt(len(points))


def _degenerate(num_points: int) -> Rejected:
    return Rejected(RejectReason.DEGENERATE, f"{num_points} points that do not determine the rotation")
