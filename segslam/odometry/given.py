"""The pose of each scan as another odometry gave it."""

from collections.abc import Callable
from typing import Literal

import numpy as np

from segslam import geometry
from segslam.config import OdometryConfig
from segslam.odometry.sweep import OdometryResult, prepare
from segslam.trajectory import Poses
from segslam.types import BadScan, Scan, Trajectory, Transform


class GivenOdometry:
    """The poses of another odometry, moved so that the first scan asked for has the identity."""

    def __init__(
        self, trajectory: Trajectory, config: OdometryConfig, *, match: Literal["scan_index", "stamp"] = "scan_index"
    ) -> None:
        """`match` says what finds a scan's row: its number, or the nearest stamp within `config.stamp_tolerance_s`."""
        self._config = config
        self._trajectory = trajectory
        self._rows = {int(scan_index): row for row, scan_index in enumerate(trajectory.scan_index)}
        self._row = self._row_of_scan if match == "scan_index" else self._row_of_stamp
        self._T_given_first: Transform | None = None
        self._T_odom_last = np.eye(4)

    def register(self, scan: Scan) -> OdometryResult:
        """The pose and the kept points of a scan. Raises BadScan if it has no pose or no point within range."""
        T_given_lidar = self._trajectory.T_world_lidar[self._row(scan)]
        T_given_first = T_given_lidar if self._T_given_first is None else self._T_given_first
        T_odom_lidar = geometry.inverse(T_given_first) @ T_given_lidar
        points, labels, intensities = prepare(scan, geometry.inverse(self._T_odom_last) @ T_odom_lidar, self._config)
        self._T_given_first, self._T_odom_last = T_given_first, T_odom_lidar
        return OdometryResult(T_odom_lidar, points.astype(np.float32), labels, intensities)

    def restore(self, T_odom_lidar: Poses, scan_of: Callable[[int], Scan]) -> None:
        """Go on after the scans that were given these poses; the first of them is read, with `scan_of`."""
        self._T_given_first = self._trajectory.T_world_lidar[self._row(scan_of(0))]
        self._T_odom_last = T_odom_lidar[-1]

    def _row_of_scan(self, scan: Scan) -> int:
        if scan.index not in self._rows:
            raise BadScan(
                f"scan {scan.index}: the odometry given has no pose for it "
                f"(it has {_span(self._trajectory.scan_index)}); leave the scan out or give a longer trajectory"
            )
        return self._rows[scan.index]

    def _row_of_stamp(self, scan: Scan) -> int:
        apart_ns = np.abs(self._trajectory.stamp_ns - scan.stamp_ns)
        row = int(np.argmin(apart_ns)) if len(apart_ns) else -1
        if row < 0 or apart_ns[row] > self._config.stamp_tolerance_s * 1e9:
            raise BadScan(
                f"scan {scan.index}: the odometry given has no pose within {self._config.stamp_tolerance_s} s of its "
                f"stamp {scan.stamp_ns} ns (it has {_span(self._trajectory.stamp_ns)}); "
                "leave the scan out, mend the stamps or raise odometry.stamp_tolerance_s"
            )
        return row


def _span(values: np.ndarray) -> str:
    return f"{values.min()} to {values.max()}" if len(values) else "none"
