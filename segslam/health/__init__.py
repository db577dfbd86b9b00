"""Health of the odometry: each motion is checked against the scans, and repaired where they contradict it."""

from segslam.health.checked import CheckedOdometry, Recover, least_informed

__all__ = ["CheckedOdometry", "Recover", "least_informed"]
