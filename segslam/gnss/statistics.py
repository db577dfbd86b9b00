"""Robust statistics of residuals: their scale, their weights, and which fixes are consistent with the drive.

Wrong fixes come in runs, under trees or beside a building: within the run they are consistent with each other, but the
drive from a correct fix into the run, and out of it, contradicts them.
"""

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from segslam.core.probabilities import SIGNIFICANT
from segslam.core.types import Mask, Points, Vector

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
RUN_S = 15.0
"""Chosen: the weight of a fix is at most that of the median residual within this time before and after it."""
NUM_FITTED = 3
"""Heading and horizontal position of a drive."""
KEPT_WEIGHT = 0.25
"""A fix is kept if its weight is that of a residual within three standard deviations, or more."""
DRIFT = 0.02
"""Chosen: share of the travel by which the drive may have drifted; odometry drifts by 1 or 2 %."""
BOUND = float(np.sqrt(chdtri(2, SIGNIFICANT)))
"""Two fixes are consistent within this many standard deviations of their difference, which has two components."""


def axis_sigma(residual_m: np.ndarray) -> float:
    """Robust standard deviation of one axis about zero, from residuals (n,) of it, or (n, 2 or 3) horizontally."""
    is_one = residual_m.ndim == 1
    median = np.median(np.abs(residual_m) if is_one else np.hypot(*residual_m[:, :2].T))
    return max(float(median) / (MEDIAN_OF_ABS if is_one else MEDIAN_OF_NORM2), LEAST_SIGMA_M)


def sigmas(residual: Points, used: Mask, used_up: Mask) -> Vector:
    """(3,) robust standard deviations east, north and up of the used residuals; infinite up if none is used there.

    Heading and position of the drive were fitted, so that few fixes have small residuals: the mean variance, given N
    residuals of p fitted numbers, is N / (N - p - 2) times their mean square (inverse chi-square).
    """
    chosen = residual[used] if used.any() else residual
    num = 2 * len(chosen)
    level = axis_sigma(chosen) * np.sqrt(num / max(num - NUM_FITTED - 2, 1))
    return np.array([level, level, axis_sigma(residual[used_up, 2]) if used_up.any() else np.inf])


def fix_noise(residual_m: np.ndarray) -> float:
    """Standard deviation of one axis from fix to fix, from changes of residuals: (n,), or (n, 2 or 3) horizontally."""
    changes = np.diff(residual_m, axis=0)
    return max(axis_sigma(changes) / np.sqrt(2.0), LEAST_NOISE_M) if len(changes) else LEAST_NOISE_M


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


def robust_weights(residual: Points, sigma: Vector, time_s: Vector | None = None) -> Weights:
    """(n, 2) weights horizontally and vertically by Geman and McClure's kernel: 1 at 0, 1/4 at 3 sigma.

    With `time_s` a fix in a run of wrong ones has the weight of the run. Unknown heights have the weight 0.
    """
    normal = np.column_stack([np.hypot(*residual[:, :2].T), np.abs(residual[:, 2])]) / sigma[[0, 2]]
    if time_s is not None:
        normal = np.column_stack([np.maximum(values, _median_near(values, time_s)) for values in normal.T])
    return np.nan_to_num((9.0 / (9.0 + normal**2)) ** 2)


def _median_near(values: Vector, time_s: Vector) -> Vector:
    """Median of the known values within `RUN_S` of each; 0 if there are none."""
    first = np.searchsorted(time_s, time_s - RUN_S)
    last = np.searchsorted(time_s, time_s + RUN_S, side="right")
    near = (values[a:b] for a, b in zip(first, last, strict=True))
    known = (some[np.isfinite(some)] for some in near)
    return np.array([float(np.median(some)) if len(some) else 0.0 for some in known])


def longest_chain(residual_m: Points, travel_m: Vector, *, sigma_m: float) -> Mask:
    """(n,) the largest subset in which each fix is consistent with the next one.

    `residual_m`: measured minus estimated position of each fix, in the order of time; only its first two columns are
    used. Two fixes are consistent if their residuals differ by their noise and the drift of the drive between them.
    """
    n = len(residual_m)
    allowed = BOUND * np.sqrt(2.0) * sigma_m
    length, previous = np.ones(n), np.full(n, -1)
    for row in range(1, n):
        gap = np.hypot(*(residual_m[row, :2] - residual_m[:row, :2]).T)
        reach = allowed + DRIFT * (travel_m[row] - travel_m[:row])
        before = np.where(gap <= reach, length[:row], 0.0)
        best = row - 1 - int(np.argmax(before[::-1]))  # the latest of equals: the least drift between
        if before[best] > 0.0:
            length[row], previous[row] = length[best] + 1.0, best
    kept = np.zeros(n, dtype=bool)
    row = int(np.argmax(length)) if n else -1
    while row >= 0:
        kept[row] = True
        row = previous[row]
    return kept
