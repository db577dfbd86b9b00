"""How much each edge of the graph is worth: noise models of odometry, of closures, of the first pose."""

import math

import gtsam
import numpy as np
from scipy.special import chdtri

from segslam import geometry
from segslam.config import GraphConfig
from segslam.pose_graph.edges import Kernel
from segslam.types import Information, Transform

DEGREES_OF_FREEDOM = 6
FIRST_POSE_SIGMA = 1e-4  # chosen (rad, m): holds the world in place, far below any other noise and above rounding
LEAST_STEP_M = 0.1  # chosen: odometry between two scans of a standing sensor jitters by centimetres


def first_pose() -> gtsam.noiseModel.Base:
    """The world is where the first keyframe says."""
    return gtsam.noiseModel.Isotropic.Sigma(DEGREES_OF_FREEDOM, FIRST_POSE_SIGMA)


def odometry_information(travel_m: float, T_a_b: Transform, config: GraphConfig) -> Information:
    """Of the motion between two keyframes: variances grow with the way travelled, and a turn counts as a way.

    One radian counts as much as `config.turn_m` metres. The defaults are calibrated on KISS-ICP in simulated streets,
    for single edges and for chains of a hundred. In between, for ten, they claim two to three times the variance: part
    of an edge's error is of its scans alone and does not add up, part is alike for hundreds of metres and adds up
    faster than independent steps do, and edges that know nothing of each other can be right at two lengths only.
    """
    way_m = max(travel_m, geometry.distance(T_a_b)) + config.turn_m * geometry.angle(T_a_b)
    growth = math.sqrt(max(way_m, LEAST_STEP_M))
    sigmas = geometry.tangent(
        rotation_rad=math.radians(config.odometry_sigma_deg) * growth, translation_m=config.odometry_sigma_m * growth
    )
    return np.diag(sigmas**-2.0)


def closure_information(information: Information, config: GraphConfig) -> Information:
    """A closure's information once the least noise of any closure is added to its covariance.

    The registration's information knows the shape of the uncertainty; what it cannot know (two scans that saw the place
    differently, a leftover vertical angle) is the least noise. The graph takes closures for independent, but neighbours
    are off by much the same: with the default, means of eight neighbours have the chi-square that is claimed (simulated
    06), single closures a third of it. Where the registration knows nothing, 1e-10 of the least noise's information
    keeps the sum positive definite.
    Raises ValueError if `information` is not symmetric positive semidefinite.
    """
    if not is_positive_semidefinite(information):
        raise ValueError("the information of a closure must be finite, symmetric and positive semidefinite")
    sigmas = geometry.tangent(rotation_rad=math.radians(config.closure_sigma_deg), translation_m=config.closure_sigma_m)
    least = np.diag(sigmas**-2.0)
    total = information @ np.linalg.solve(information + least, least)  # inverse(inverse(I) + inverse(L)), I may be flat
    return (total + total.T) / 2 + 1e-10 * least


def is_positive_semidefinite(matrix: Information) -> bool:
    """Whether a matrix is finite, symmetric and without a negative eigenvalue, up to rounding."""
    if not np.isfinite(matrix).all():
        return False
    tolerance = 1e-9 * max(float(np.abs(matrix).max()), np.finfo(float).tiny)
    return bool(np.abs(matrix - matrix.T).max() <= tolerance and np.linalg.eigvalsh(matrix).min() >= -tolerance)


def inlier_bound(probability: float, *, error_allowance: float = 1.0) -> float:
    """The squared whitened error (chi-square, not half of it) below which a true edge lies with this probability.

    `error_allowance`: when errors are so many times as large as claimed.
    """
    return error_allowance**2 * float(chdtri(DEGREES_OF_FREEDOM, 1.0 - probability))


def kernel(name: str, inlier_bound: float) -> Kernel | None:
    """A robust kernel as wide as the bound of inliers; None for least squares (`none`)."""
    estimators = gtsam.noiseModel.mEstimator
    width = math.sqrt(inlier_bound)
    match name:
        case "none":
            return None
        case "huber":
            return estimators.Huber.Create(width)
        case "cauchy":
            return estimators.Cauchy.Create(width)
        case "geman-mcclure":
            return estimators.GemanMcClure.Create(width)
    raise ValueError(f"no kernel {name}")
