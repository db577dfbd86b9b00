"""Interface of all odometries: scans in, poses and motion-compensated, cropped points out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from kiss_icp.preprocess import Preprocessor

from segslam.core.config import OdometryConfig
from segslam.core.points import is_finite, within_range
from segslam.core.types import BadScan, Motion, Points, Scan, ScanLabels, Transform, Vector
from segslam.labels.label_files import of_rows


@dataclass(frozen=True, slots=True, eq=False)
class OdometryResult:
    """The pose of a scan and its points."""

    T_odom_lidar: Transform
    """Odom is the frame of the LiDAR at the first scan, so the first pose is the identity."""
    points: Points
    """(n, 3) float32 in the LiDAR frame at the end of the sweep; in range; motion-compensated if times are known."""
    labels: ScanLabels
    """(n,) labels, or a function that computes them."""
    intensities: Vector | None = None
    """(n,) intensities; None if unknown."""
    motion: Motion | None = None
    """Result of the check of the motion; None if it was not checked."""


@runtime_checkable
class Odometry(Protocol):
    """Estimates the pose of each scan in the frame of the first."""

    @property
    def is_from_scans(self) -> bool:
        """True if it uses these scans only, so that a better registration of them replaces its result."""
        ...

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        """The pose and the cropped points of the next scan, in order of time. Raises BadScan for an unusable scan.

        `gap`: time since the previous scan in intervals of the sensor; above 1 if scans between them were lost.
        """
        ...

    def follow(
        self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform, T_before_lidar: Transform
    ) -> None:
        """Continue from another pose of the last scan, with a local map of these scans (poses and downsampled points).

        `T_before_lidar`: the motion between the last two scans, per interval of the sensor.
        """
        ...


def deskew_scan(
    scan: Scan, T_last_lidar: Transform, config: OdometryConfig
) -> tuple[Points, ScanLabels, Vector | None]:
    """Points (n, 3) float64 as measured at the end of the sweep and within range; their labels and intensities.

    Points are cropped after the motion compensation, as in KISS-ICP, which would crop without the labels.
    `T_last_lidar`: motion of the sensor during the sweep.
    """
    points = _at_sweep_end(scan, T_last_lidar, config) if config.deskew else scan.points.astype(np.float64)
    kept = within_range(points, config.min_range_m, config.max_range_m)
    if not kept.any():
        raise BadScan(
            f"scan {scan.index}: none of its {len(kept)} points lies between {config.min_range_m} and "
            f"{config.max_range_m} m; omit the scan or change odometry.min_range_m, odometry.max_range_m"
        )
    intensities = None if scan.intensities is None else scan.intensities[kept]
    return points.compress(kept, axis=0), of_rows(scan.labels, kept), intensities


def _at_sweep_end(scan: Scan, T_last_lidar: Transform, config: OdometryConfig) -> Points:
    """The points as measured at the end of the sweep, if the sensor moves by `T_last_lidar` during it."""
    points = scan.points.astype(np.float64)
    if len(scan.times) == 0 or np.ptp(scan.times) == 0:
        return points
    everything = Preprocessor(max_range=np.inf, min_range=-1.0, deskew=True, max_num_threads=config.max_num_threads)
    finite = is_finite(points)  # KISS-ICP drops other points, which would change the order of the rows
    # KISS-ICP normalises the times to the whole sweep; two added points mark its start and end
    marked = np.concatenate([points[finite], np.ones((2, 3))])
    times = np.concatenate([scan.times[finite].astype(np.float64), [0.0, 1.0]])
    points[finite] = everything.preprocess(marked, times, T_last_lidar)[:-2]
    return points
