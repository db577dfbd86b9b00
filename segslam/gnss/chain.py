"""The largest chain of fixes that are consistent with the drive between them.

Wrong fixes come in runs, under trees or beside a building: within the run they are consistent with each other, but the
drive from a correct fix into the run, and out of it, contradicts them.
"""

import numpy as np

from segslam.core.types import Mask, Points, Vector

DRIFT = 0.02
"""Chosen: share of the travel by which the drive may have drifted; odometry drifts by 1 or 2 %."""
BOUND = 3.5
"""Chosen: two fixes are consistent within this many standard deviations of their difference."""


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
