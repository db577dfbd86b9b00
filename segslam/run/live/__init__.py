"""Mapping while scans arrive: sources of scans, and odometry in a process that other work does not delay."""

from segslam.run.live.folder import FolderSource
from segslam.run.live.front import Front
from segslam.run.live.live_map import LiveMap
from segslam.run.live.serve import Placed
from segslam.run.live.waiting import Source

__all__ = ["FolderSource", "Front", "LiveMap", "Placed", "Source"]
