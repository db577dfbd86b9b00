"""The vertical angle of the scans, as all registered submaps of a drive measure it together."""

import math
from collections.abc import Sequence

import numpy as np

from segslam.adjustment.registrations import RegisteredPair
from segslam.calibration import BIAS_DEG, MOST_SIGMA_DEG, VerticalAngle

MIN_PAIRS = 24
"""Chosen: 12 to 15 pairs of a drive in a courtyard have a median of -0.12 degrees."""


def vertical_angle(pairs: Sequence[RegisteredPair]) -> VerticalAngle | None:
    """The median over registered pairs, with its standard deviation; None if too few pairs determine the angle."""
    found = np.degrees([(one.alignment.angle_rad, one.alignment.angle_sigma_rad) for one in pairs]).reshape(-1, 2)
    angles = found[found[:, 1] < MOST_SIGMA_DEG, 0]
    if len(angles) < MIN_PAIRS:
        return None
    median = float(np.median(angles))
    spread = 1.4826 * float(np.median(np.abs(angles - median)))
    error = math.sqrt(math.pi / 2 / len(angles)) * spread  # standard error of the median of normal errors
    return VerticalAngle(median, math.hypot(error, BIAS_DEG), len(angles))
