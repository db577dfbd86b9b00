"""The pose of each scan in the frame of the first: by KISS-ICP (Vizzo et al., RA-L 2023), or as given."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.config.parser import KISSConfig
from kiss_icp.kiss_icp import KissICP
from kiss_icp.preprocess import Preprocessor

from segslam import geometry
from segslam.config import OdometryConfig
from segslam.points import within_range
from segslam.trajectory import Poses
from segslam.types import BadScan, Labels, Points, Scan, Trajectory, Transform


@dataclass(frozen=True, slots=True, eq=False)
class OdometryResult:
    """Where a scan was taken, and what of it is kept."""

    T_odom_lidar: Transform
    """Odom is the LiDAR's frame at the first scan, so the first pose is the identity."""
    points: Points
    """In the LiDAR's frame at the sweep's end, motion-compensated where the scan has times, within range, float32."""
    labels: Labels
    """A row for each point."""


@runtime_checkable
class Odometry(Protocol):
    def register(self, scan: Scan) -> OdometryResult:
        """The pose and the kept points of the next scan, in order of time. Raises BadScan for an unusable scan."""
        ...

    def restore(self, T_odom_lidar: Poses, scan_of: Callable[[int], Scan]) -> None:
        """Go on after the scans that were given these poses, one or more; `scan_of` reads the scan of a row."""
        ...


class KissOdometry:
    """KISS-ICP, scan to local map.

    With one thread it repeats to the bit, with more to millimetres. The number of threads is that of the first made in
    a process: KISS-ICP keeps it.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._kiss = KissICP(_kiss_config(config))

    def register(self, scan: Scan) -> OdometryResult:
        """The pose and the kept points of the next scan, in order of time.

        Raises BadScan, and forgets the scan, if none of its points is within range.
        """
        points, labels = _prepare(scan, self._kiss.last_delta, self._config)
        self._kiss.register_frame(points, np.empty(0))
        return OdometryResult(np.array(self._kiss.last_pose), points.astype(np.float32), labels)

    def restore(self, T_odom_lidar: Poses, scan_of: Callable[[int], Scan]) -> None:
        """The state, to the bit, that registering the scans of these poses has left. `scan_of` reads the scan of a row.

        Read are those that can have left points in the local map: it forgets what lies farther than its range, so a
        scan taken at twice the range from the last, and all before it, have nothing in it.
        """
        kiss = self._kiss
        apart_m = np.linalg.norm(T_odom_lidar[:, :3, 3] - T_odom_lidar[-1, :3, 3], axis=1)
        forgotten = np.flatnonzero(apart_m > 2 * self._config.max_range_m)
        first = forgotten[-1] + 1 if len(forgotten) else 0
        for row, T_odom_now in enumerate(T_odom_lidar):
            if row >= first:
                points, _ = _prepare(scan_of(row), kiss.last_delta, self._config)
                kiss.local_map.update(kiss.voxelize(points)[1], T_odom_now)
            T_odom_predicted = kiss.last_pose @ kiss.last_delta
            kiss.adaptive_threshold.update_model_deviation(np.linalg.inv(T_odom_predicted) @ T_odom_now)
            kiss.last_delta = np.linalg.inv(kiss.last_pose) @ T_odom_now  # inverted as by KISS-ICP: same bits
            kiss.last_pose = T_odom_now


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
        points, labels = _prepare(scan, geometry.inverse(self._T_odom_last) @ T_odom_lidar, self._config)
        self._T_given_first, self._T_odom_last = T_given_first, T_odom_lidar
        return OdometryResult(T_odom_lidar, points.astype(np.float32), labels)

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


def _prepare(scan: Scan, T_last_lidar: Transform, config: OdometryConfig) -> tuple[Points, Labels]:
    """The points (float64) as at the sweep's end, those within range, and their labels.

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
    return np.ascontiguousarray(points[kept]), scan.labels[kept]


def _at_sweep_end(scan: Scan, T_last_lidar: Transform, config: OdometryConfig) -> Points:
    """Each point where it would have been seen at the sweep's end, had the sensor moved as `T_last_lidar` says."""
    points = scan.points.astype(np.float64)
    if len(scan.times) == 0 or np.ptp(scan.times) == 0:
        return points
    everything = Preprocessor(max_range=np.inf, min_range=-1.0, deskew=True, max_num_threads=config.max_num_threads)
    finite = np.isfinite(points).all(axis=1)  # KISS-ICP drops the others, and with them the order of rows
    points[finite] = everything.preprocess(points[finite], scan.times[finite].astype(np.float64), T_last_lidar)
    return points


def _kiss_config(config: OdometryConfig) -> KISSConfig:
    """Every section is given: KISS-ICP would read a missing one from the environment."""
    return KISSConfig(
        data=DataConfig(max_range=config.max_range_m, min_range=config.min_range_m, deskew=False),
        mapping=MappingConfig(voxel_size=config.voxel_size_m),
        registration=RegistrationConfig(max_num_threads=config.max_num_threads),
        adaptive_threshold=AdaptiveThresholdConfig(),
    )


def _span(values: np.ndarray) -> str:
    return f"{values.min()} to {values.max()}" if len(values) else "none"
