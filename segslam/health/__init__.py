"""Health of the odometry: motions are checked against the scans, and repaired if the scans contradict them."""

from segslam.health.checked import CheckedOdometry, information_of
from segslam.health.search import Recover

__all__ = ["CheckedOdometry", "Recover", "information_of"]
