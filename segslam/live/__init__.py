"""Mapping while scans arrive: sources of scans, and odometry in a process that other work does not delay."""

from segslam.live.folder import FolderSource
from segslam.live.front import Front
from segslam.live.live_map import LiveMap
from segslam.live.placed import Ended, Placed
from segslam.live.source import Source

__all__ = ["Ended", "FolderSource", "Front", "LiveMap", "Placed", "Source"]
