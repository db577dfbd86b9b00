"""Adjustment of the whole map after the loops: submaps are registered with each other, and all poses are solved."""

from segslam.slam.adjustment.known import Known
from segslam.slam.adjustment.progress import Progress, no_progress
from segslam.slam.adjustment.record import Adjustment
from segslam.slam.adjustment.rounds import Adjusted, adjust

__all__ = ["Adjusted", "Adjustment", "Known", "Progress", "adjust", "no_progress"]
