"""What every odometry takes and gives: a sweep, motion-compensated and cropped, and its pose."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from kiss_icp.preprocess import Preprocessor

from segslam.config import OdometryConfig
from segslam.points import is_finite, within_range
from segslam.semantics.late import of_rows
from segslam.trajectory import Poses
from segslam.types import BadScan, Motion, Points, Scan, ScanLabels, Transform, Vector


@dataclass(frozen=True, slots=True, eq=False)
class OdometryResult:
    """Where a scan was taken, and what of it is kept."""

    T_odom_lidar: Transform
    """Odom is the LiDAR's frame at the first scan, so the first pose is the identity."""
    points: Points
    """In the LiDAR's frame at the sweep's end, motion-compensated where the scan has times, within range, float32."""
    labels: ScanLabels
    """A row for each point; or what makes them."""
    intensities: Vector | None = None
    """The same, where the scan has them."""
    motion: Motion | None = None
    """How the motion was checked; None where it was not."""


Followed = tuple[int, Sequence[tuple[Transform, Points]]]
"""Row of a scan, and the scans (pose, thinned points) of the local map that `Odometry.follow` was given after it."""


@runtime_checkable
class Odometry(Protocol):
    """Gives every scan a pose in the frame of the first."""

    @property
    def is_from_scans(self) -> bool:
        """Whether it knows nothing but these scans, so that a better registration of them supersedes it."""
        ...

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        """The pose and the kept points of the next scan, in order of time. Raises BadScan for an unusable scan.

        `gap`: time since the scan before, in intervals of the sensor, where scans between were lost.
        """
        ...

    def restore(self, T_odom_lidar: Poses, scan_of: Callable[[int], Scan], *, since: Followed | None = None) -> None:
        """Go on after the scans that were given these poses, one or more; `scan_of` reads the scan of a row.

        `since`: the last row after which `follow` was called, and the scans that it was given.
        """
        ...

    def follow(
        self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform, T_before_lidar: Transform
    ) -> None:
        """Go on from another pose of the last scan, with a local map of these scans (poses and thinned points).

        `T_before_lidar` is the motion between the last two scans.
        """
        ...


def deskew_scan(
    scan: Scan, T_last_lidar: Transform, config: OdometryConfig
) -> tuple[Points, ScanLabels, Vector | None]:
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
    return points.compress(kept, axis=0), of_rows(scan.labels, kept), intensities


def _at_sweep_end(scan: Scan, T_last_lidar: Transform, config: OdometryConfig) -> Points:
    """The points as measured at the end of the sweep, if the sensor moves by `T_last_lidar` during it."""
    points = scan.points.astype(np.float64)
    if len(scan.times) == 0 or np.ptp(scan.times) == 0:
        return points
    everything = Preprocessor(max_range=np.inf, min_range=-1.0, deskew=True, max_num_threads=config.max_num_threads)
    finite = is_finite(points)  # KISS-ICP drops the others, and with them the order of rows
    # KISS-ICP stretches the times that it is given to the whole sweep, so two points mark its start and end
    marked = np.concatenate([points[finite], np.ones((2, 3))])
    times = np.concatenate([scan.times[finite].astype(np.float64), [0.0, 1.0]])
    points[finite] = everything.preprocess(marked, times, T_last_lidar)[:-2]
    return points
