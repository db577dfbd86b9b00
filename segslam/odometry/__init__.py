"""Odometry: the pose of each scan in the frame of the first, by KISS-ICP or from a given trajectory."""

from segslam.odometry.apart import OdometryApart
from segslam.odometry.given import GivenOdometry
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.sweep import Followed, Odometry, OdometryResult, deskew_scan

__all__ = [
    "Followed",
    "GivenOdometry",
    "KissOdometry",
    "Odometry",
    "OdometryApart",
    "OdometryResult",
    "deskew_scan",
]
