"""Truncated least squares by graduated non-convexity: the weights of the surrogate, for points and for closures.

Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020, section IV.
`squared` is r_i^2, `squared_bound` is c bar^2 in the same unit, `control` is mu, which grows from near 0 (convex) by
CONTROL_FACTOR at each step.
"""

import math

import numpy as np

from segslam.core.types import Vector

CONTROL_FACTOR = 1.4
"""Growth of mu in the paper, and in the program of Segregator's authors."""


def first_control(worst_squared: float, squared_bound: float) -> float:
    """The first value of mu; 0 if all residuals are so small that the convex problem is the truncated one."""
    excess = 2.0 * worst_squared / squared_bound - 1.0
    return 1.0 / excess if excess > 0.0 else 0.0


def tls_weights(squared: Vector, control: float, squared_bound: float) -> Vector:
    """(k,) weights in [0, 1]: 1 for small residuals, 0 for large ones. Eq. (14)."""
    near = control / (control + 1.0) * squared_bound  # up to here the weight is 1
    between = math.sqrt(squared_bound) * np.sqrt(control * (control + 1.0) / np.maximum(squared, near)) - control
    return np.maximum(between, 0.0)  # the outer cases of Eq. (14) are where the middle one leaves [0, 1]
