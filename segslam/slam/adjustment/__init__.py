"""Adjustment of the whole map after the loops: submaps are registered with each other, and all poses are solved."""

from segslam.slam.adjustment.known import Known
from segslam.slam.adjustment.rounds import Adjusted, Adjustment, Progress, adjust, no_progress

__all__ = ["Adjusted", "Adjustment", "Known", "Progress", "adjust", "no_progress"]
