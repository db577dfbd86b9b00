"""Adjustment of the whole map after the loops: submaps are registered with each other, and all poses are solved."""

from segslam.slam.adjustment.known import Known
from segslam.slam.adjustment.rounds import Adjusted, Adjustment, Progress, adjust, no_progress
from segslam.slam.adjustment.sweeps import Correction, Sweep, Velocities, corrections_of, velocities_of

__all__ = [
    "Adjusted",
    "Adjustment",
    "Correction",
    "Known",
    "Progress",
    "Sweep",
    "Velocities",
    "adjust",
    "corrections_of",
    "no_progress",
    "velocities_of",
]
