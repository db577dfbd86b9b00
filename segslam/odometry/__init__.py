"""Odometry: the pose of each scan in the frame of the first, and how certain each motion is.

KISS-ICP or a given trajectory proposes motions; they are compared with the scans and replaced by more likely ones.
"""

from segslam.odometry.apart import OdometryApart
from segslam.odometry.checked import CheckedOdometry
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.motion_model import information_of
from segslam.odometry.search import Recover
from segslam.odometry.sweep import GivenOdometry, Odometry, OdometryResult, deskew_scan
from segslam.odometry.tracker import Tracked, Tracker

__all__ = [
    "CheckedOdometry",
    "GivenOdometry",
    "KissOdometry",
    "Odometry",
    "OdometryApart",
    "OdometryResult",
    "Recover",
    "Tracked",
    "Tracker",
    "deskew_scan",
    "information_of",
]
