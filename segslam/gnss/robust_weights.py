"""Robust weights of fixes: those of a run of wrong ones are small together."""

import numpy as np

from segslam.core.types import Points, Vector
from segslam.gnss.statistics import Weights, weight

RUN_S = 15.0
"""Chosen: the weight of a fix is at most that of the median residual within this time before and after it."""
KEPT_WEIGHT = 0.25
"""A fix is kept if its weight is that of a residual within three standard deviations, or more."""


def robust_weights(residual: Points, sigma: Vector, time_s: Vector) -> Weights:
    """(n, 2) weights horizontally and vertically; a fix in a run of wrong ones has the weight of the run."""
    level = np.hypot(*residual[:, :2].T) / sigma[0]
    up = np.abs(residual[:, 2]) / sigma[2]
    of_run = [_median_near(values, time_s) for values in (level, up)]
    level, up = np.maximum(level, of_run[0]), np.maximum(up, of_run[1])
    return np.column_stack([weight(level**2), np.where(np.isfinite(up), weight(np.nan_to_num(up) ** 2), 0.0)])


def _median_near(values: Vector, time_s: Vector) -> Vector:
    first = np.searchsorted(time_s, time_s - RUN_S)
    last = np.searchsorted(time_s, time_s + RUN_S, side="right")
    return np.array([_median(values[a:b]) for a, b in zip(first, last, strict=True)])


def _median(values: Vector) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0
