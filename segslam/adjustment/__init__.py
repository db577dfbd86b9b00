"""Adjustment of the whole map after the loops: submaps are registered with each other, and all poses are solved."""

from segslam.adjustment.progress import Progress, no_progress
from segslam.adjustment.record import Adjustment
from segslam.adjustment.rounds import Adjusted, adjust

__all__ = ["Adjusted", "Adjustment", "Progress", "adjust", "no_progress"]
