"""Robust statistics of residuals: their scale, and for how many fixes in a row they are similar."""

import numpy as np
from jaxtyping import Float

from segslam.core.types import Vector

Weights = Float[np.ndarray, "_ 2"]
"""Robust weights of fixes, horizontally and in height."""
MEDIAN_OF_NORM2 = 1.1774
"""Median of the length of a vector of two independent standard normal variables."""
MEDIAN_OF_ABS = 0.6745
"""Median of the absolute value of a standard normal variable."""
LEAST_SIGMA_M = 0.01
"""Chosen: no fix is better than a centimetre."""
LEAST_NOISE_M = 0.05
"""Chosen: the position of a scan between two others is not known better at the time of a fix."""
CLIPPED_AT = 3.0
"""Chosen: residuals beyond this many standard deviations count as this many for the autocorrelation."""


def horizontal_sigma(residual_m: np.ndarray) -> float:
    """Robust standard deviation of one axis, from the median length of horizontal residuals (n, 2)."""
    return max(float(np.median(np.hypot(*residual_m[:, :2].T))) / MEDIAN_OF_NORM2, LEAST_SIGMA_M)


def axis_sigma(residual_m: Vector) -> float:
    """Robust standard deviation of residuals (n,) of one axis, about zero."""
    return max(float(np.median(np.abs(residual_m))) / MEDIAN_OF_ABS, LEAST_SIGMA_M)


def horizontal_noise(residual_m: np.ndarray) -> float:
    """Standard deviation of one axis from fix to fix, from the changes of horizontal residuals (n, 2 or 3)."""
    changes = np.diff(residual_m[:, :2], axis=0)
    return max(horizontal_sigma(changes) / np.sqrt(2.0), LEAST_NOISE_M) if len(changes) else LEAST_NOISE_M


def axis_noise(residual_m: Vector) -> float:
    """The same for residuals (n,) of one axis."""
    changes = np.diff(residual_m)
    return max(axis_sigma(changes) / np.sqrt(2.0), LEAST_NOISE_M) if len(changes) else LEAST_NOISE_M


def weight(squared: Vector, bound: float = 9.0) -> Vector:
    """Weight of residuals by Geman and McClure's kernel, for squared normalised residuals: 1 at 0, 1/4 at the bound."""
    return (bound / (bound + squared)) ** 2


def correlated(residuals: np.ndarray) -> float:
    """How many fixes in a row count as one: the integrated autocorrelation of residuals (n, d), from 1 to n / 4.

    The errors of a receiver change slowly, so that their mean over n fixes is worse than that of n independent ones.
    """
    n = len(residuals)
    if n < 8:
        return 1.0
    sigma = np.maximum(np.median(np.abs(residuals), axis=0) / MEDIAN_OF_ABS, 1e-9)
    clipped = np.clip(residuals / sigma, -CLIPPED_AT, CLIPPED_AT)
    clipped = clipped - clipped.mean(axis=0)
    variance = float(np.mean(clipped**2))
    if variance <= 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, n // 2):
        share = float(np.mean(clipped[lag:] * clipped[:-lag])) / variance
        if share <= 0.05:
            break
        total += 2.0 * share
    return float(np.clip(total, 1.0, n / 4))
