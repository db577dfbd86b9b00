"""Health of the odometry: motions are checked against the scans, and repaired if the scans contradict them."""

from segslam.health.checked import CheckedOdometry
from segslam.health.search import Recover
from segslam.health.unconstrained import information_of

__all__ = ["CheckedOdometry", "Recover", "information_of"]
