"""What every odometry takes and gives: a sweep, motion-compensated and cropped, and its pose."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from kiss_icp.preprocess import Preprocessor

from segslam.config import OdometryConfig
from segslam.points import is_finite, within_range
from segslam.trajectory import Poses
from segslam.types import BadScan, Labels, Points, Scan, Transform, Vector


@dataclass(frozen=True, slots=True, eq=False)
class OdometryResult:
    """Where a scan was taken, and what of it is kept."""

    T_odom_lidar: Transform
    """Odom is the LiDAR's frame at the first scan, so the first pose is the identity."""
    points: Points
    """In the LiDAR's frame at the sweep's end, motion-compensated where the scan has times, within range, float32."""
    labels: Labels
    """A row for each point."""
    intensities: Vector | None = None
    """The same, where the scan has them."""


@runtime_checkable
class Odometry(Protocol):
    """Gives every scan a pose in the frame of the first."""

    def register(self, scan: Scan) -> OdometryResult:
        """The pose and the kept points of the next scan, in order of time. Raises BadScan for an unusable scan."""
        ...

    def restore(self, T_odom_lidar: Poses, scan_of: Callable[[int], Scan]) -> None:
        """Go on after the scans that were given these poses, one or more; `scan_of` reads the scan of a row."""
        ...


def prepare(scan: Scan, T_last_lidar: Transform, config: OdometryConfig) -> tuple[Points, Labels, Vector | None]:
    """The points (float64) as at the sweep's end, those within range, their labels and, where known, intensities.

    The crop comes after the motion compensation, as in KISS-ICP, which would crop without the labels:
    it is handed what this leaves.
    """
    points = _at_sweep_end(scan, T_last_lidar, config) if config.deskew else scan.points.astype(np.float64)
    kept = within_range(points, config.min_range_m, config.max_range_m)
    if not kept.any():
        raise BadScan(
            f"scan {scan.index}: none of its {len(kept)} points lies between {config.min_range_m} and "
            f"{config.max_range_m} m; leave the scan out or change odometry.min_range_m, odometry.max_range_m"
        )
    intensities = None if scan.intensities is None else scan.intensities[kept]
    return points.compress(kept, axis=0), scan.labels[kept], intensities


def _at_sweep_end(scan: Scan, T_last_lidar: Transform, config: OdometryConfig) -> Points:
    """Each point where it would have been seen at the sweep's end, had the sensor moved as `T_last_lidar` says."""
    points = scan.points.astype(np.float64)
    if len(scan.times) == 0 or np.ptp(scan.times) == 0:
        return points
    everything = Preprocessor(max_range=np.inf, min_range=-1.0, deskew=True, max_num_threads=config.max_num_threads)
    finite = is_finite(points)  # KISS-ICP drops the others, and with them the order of rows
    points[finite] = everything.preprocess(points[finite], scan.times[finite].astype(np.float64), T_last_lidar)
    return points
