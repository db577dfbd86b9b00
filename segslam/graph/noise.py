"""Noise models of the edges: odometry, closures, first pose."""

import math

import gtsam
import numpy as np
from scipy.special import chdtri

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.core.probabilities import INLIER_PROBABILITY
from segslam.core.types import Information, Transform
from segslam.graph.edges import Kernel

TURN_M = 5.0
"""Measured (simulated streets): distance whose noise equals that of a rotation by one radian (m)."""
CLOSURE_SIGMA_M = 0.04
"""Measured (simulated 06): smallest translation noise of a closure (m)."""
CLOSURE_SIGMA_DEG = 0.08
"""Measured (simulated 06): smallest rotation noise of a closure (degrees)."""
CLOSURE_NOISE = np.diag(
    geometry.tangent(rotation_rad=math.radians(CLOSURE_SIGMA_DEG), translation_m=CLOSURE_SIGMA_M) ** 2
)
"""Smallest covariance of any closure."""

DEGREES_OF_FREEDOM = 6
FIRST_POSE = gtsam.noiseModel.Isotropic.Sigma(DEGREES_OF_FREEDOM, 1e-4)
"""Noise of the prior on the first keyframe. Chosen (rad, m): holds the world in place, far below any other noise and
above rounding."""
LEAST_STEP_M = 0.1  # chosen: odometry between two scans of a standing sensor jitters by centimetres

UNKNOWN_MOTION = np.diag(geometry.tangent(rotation_rad=math.pi, translation_m=1000.0) ** -2.0)
"""Information of an unknown motion. Chosen: standard deviations of half a turn and a kilometre, more than any break."""
CERTAIN = 1e12 * np.eye(6)
"""Information of an exactly known pose."""


def odometry_information(travel_m: float, T_a_b: Transform, config: GraphConfig) -> Information:
    """Information of the motion between two keyframes: variances grow with the distance travelled and the rotation.

    One radian counts as much as `TURN_M` metres. The defaults are calibrated on KISS-ICP in simulated streets,
    for single edges and for chains of a hundred. For chains of ten they overestimate the variance two to three times:
    part of the error of an edge does not accumulate, part is correlated over hundreds of metres, and independent edges
    can match this growth at two chain lengths only.
    """
    way_m = max(travel_m, geometry.distance(T_a_b)) + TURN_M * geometry.angle(T_a_b)
    growth = math.sqrt(max(way_m, LEAST_STEP_M))
    sigmas = geometry.tangent(
        rotation_rad=math.radians(config.odometry_sigma_deg) * growth, translation_m=config.odometry_sigma_m * growth
    )
    return np.diag(sigmas**-2.0)


def motion_information(information: Information) -> Information:
    """The information of a motion that was not measured by odometry, regularised.

    The information of `UNKNOWN_MOTION` is added: it keeps every sum of covariances finite, and changes no other motion.
    Raises ValueError if `information` is not symmetric positive semidefinite.
    """
    _check(information, "motion")
    return (information + information.T) / 2 + UNKNOWN_MOTION


def closure_information(information: Information) -> Information:
    """A closure's information after the smallest noise of any closure is added to its covariance.

    The registration gives the shape of the uncertainty. The smallest noise covers errors that it cannot observe, like
    a remaining vertical angle. The graph treats closures as independent, but the errors of neighbours are similar: with
    the default, means of eight neighbours have the modelled chi-square (simulated 06), single closures a third of it.
    In directions without information, 1e-10 of the smallest noise's information keeps the sum positive definite.
    Raises ValueError if `information` is not symmetric positive semidefinite.
    """
    _check(information, "closure")
    return geometry.with_covariance(information, CLOSURE_NOISE) + 1e-10 * np.linalg.inv(CLOSURE_NOISE)


def _check(information: Information, what: str) -> None:
    """Raises ValueError unless it is finite, symmetric and without a negative eigenvalue, up to rounding."""
    if np.isfinite(information).all():
        tolerance = 1e-9 * max(float(np.abs(information).max()), np.finfo(float).tiny)
        is_symmetric = np.abs(information - information.T).max() <= tolerance
        if is_symmetric and np.linalg.eigvalsh(information).min() >= -tolerance:
            return
    raise ValueError(f"the information of a {what} must be finite, symmetric and positive semidefinite")


def inlier_bound(probability: float = INLIER_PROBABILITY, *, error_allowance: float = 1.0) -> float:
    """Squared whitened error (chi-square, not half of it) that a correct edge is below with this probability.

    `error_allowance`: tolerated ratio of real to modelled errors.
    """
    return error_allowance**2 * float(chdtri(DEGREES_OF_FREEDOM, 1.0 - probability))


def robust_kernel(name: str, inlier_bound: float) -> Kernel | None:
    """A robust kernel as wide as the bound of inliers; None for least squares (`none`)."""
    kinds = {"huber": "Huber", "cauchy": "Cauchy", "geman-mcclure": "GemanMcClure"}
    return None if name == "none" else getattr(gtsam.noiseModel.mEstimator, kinds[name]).Create(math.sqrt(inlier_bound))
