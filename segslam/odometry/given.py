"""Odometry from a given trajectory."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from segslam.core import geometry
from segslam.core.config import OdometryConfig
from segslam.core.types import BadScan, Points, Scan, Trajectory, Transform
from segslam.odometry.sweep import OdometryResult, deskew_scan

STAMP_TOLERANCE_S = 0.01
"""Chosen: largest time difference between a scan and its pose in a given trajectory (s)."""


class GivenOdometry:
    """The poses of a given trajectory, relative to the pose of the first registered scan."""

    is_from_scans = False

    def __init__(
        self, trajectory: Trajectory, config: OdometryConfig, *, match: Literal["scan_index", "stamp"] = "scan_index"
    ) -> None:
        """`match`: find the row of a scan by its number, or by the nearest stamp within `STAMP_TOLERANCE_S`."""
        self._config = config
        self._trajectory = trajectory
        self._rows = {int(scan_index): row for row, scan_index in enumerate(trajectory.scan_index)}
        self._row = self._row_of_scan if match == "scan_index" else self._row_of_stamp
        self._T_odom_given: Transform | None = None
        """Transform from the frame of the trajectory to the odometry's frame."""
        self._T_given_last = np.eye(4)
        self._T_odom_last = np.eye(4)

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        """The pose and the cropped points of a scan. Raises BadScan if it has no pose, or no point within range."""
        T_given_lidar = self._trajectory.T_world_lidar[self._row(scan)]
        T_odom_given = geometry.inverse(T_given_lidar) if self._T_odom_given is None else self._T_odom_given
        T_odom_lidar = T_odom_given @ T_given_lidar
        points, labels, intensities = deskew_scan(
            scan, geometry.scaled(geometry.inverse(self._T_odom_last) @ T_odom_lidar, 1 / gap), self._config
        )
        self._T_odom_given, self._T_odom_last, self._T_given_last = T_odom_given, T_odom_lidar, T_given_lidar
        return OdometryResult(T_odom_lidar, points.astype(np.float32), labels, intensities)

    def follow(
        self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform, T_before_lidar: Transform
    ) -> None:
        """Continue from another pose of the last scan."""
        self._T_odom_given = T_odom_lidar @ geometry.inverse(self._T_given_last)
        self._T_odom_last = T_odom_lidar

    def _row_of_scan(self, scan: Scan) -> int:
        if scan.index not in self._rows:
            raise BadScan(
                f"scan {scan.index}: the given odometry has no pose for it "
                f"(it has {_span(self._trajectory.scan_index)}); omit the scan or give a longer trajectory"
            )
        return self._rows[scan.index]

    def _row_of_stamp(self, scan: Scan) -> int:
        apart_ns = np.abs(self._trajectory.stamp_ns - scan.stamp_ns)
        row = int(np.argmin(apart_ns)) if len(apart_ns) else -1
        if row < 0 or apart_ns[row] > STAMP_TOLERANCE_S * 1e9:
            raise BadScan(
                f"scan {scan.index}: the given odometry has no pose within {STAMP_TOLERANCE_S} s of its "
                f"stamp {scan.stamp_ns} ns (it has {_span(self._trajectory.stamp_ns)}); "
                "omit the scan, or correct the stamps"
            )
        return row


def _span(values: np.ndarray) -> str:
    return f"{values.min()} to {values.max()}" if len(values) else "none"
