"""Times of the points as fractions of the sweep, from the various units and origins that drivers use."""

import numpy as np

from segslam.core.types import Vector

UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
"""Seconds (driver of Velodyne), microseconds and nanoseconds (Hesai, Livox, Ouster)."""
PERIODS_S = (0.05, 0.1, 0.2)
"""Periods of rotating LiDARs: 20, 10 or 5 Hz."""
LONGEST_SEAM = 0.29
"""Chosen: largest fraction of a period without returns at either end of the sweep.

Above it, 15 Hz is taken for 10 Hz.
"""
LEAST_SHARE = 0.5
"""Chosen: times between 0 and 1 that span this are fractions; no LiDAR turns as slowly as twice per second."""
JITTER = 0.02
"""Chosen: relative tolerance of a period."""


def sweep_times(times: np.ndarray, num_points: int, stamp_s: float | None = None) -> Vector:
    """Time (n,) of each point: 0 at the start of the sweep, 1 at its end.

    `times` (n,) may count from the start of the sweep, up to its end (negative), or absolutely with the start
    `stamp_s`; or they are fractions already. They are divided by the period of the sensor if a usual one fits, so
    that a sweep without returns at its start or end is not stretched; otherwise by their span. Empty if times are
    missing, not finite, all equal, or not one per point.
    """
    if len(times) != num_points or num_points == 0 or not np.isfinite(times).all():
        return np.empty(0)
    first, last = float(times.min()), float(times.max())
    if not 0.0 < last - first < np.inf:
        return np.empty(0)
    if first >= 0.0 and last <= 1.0 and last - first >= LEAST_SHARE:
        return times
    for unit_s in UNITS_S:
        for period in (period_s / unit_s for period_s in PERIODS_S):
            if not (1.0 - LONGEST_SEAM) * period <= last - first <= (1.0 + JITTER) * period:
                continue
            absolute = () if stamp_s is None else (stamp_s / unit_s,)
            for start in (0.0, -period, *absolute):
                if start - JITTER * period <= first and last <= start + (1.0 + JITTER) * period:
                    return np.clip((times - start) / period, 0.0, 1.0)
    return (times - first) / (last - first)
