"""Interface of all odometries: scans in, poses and motion-compensated, cropped points out; and a given trajectory."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from kiss_icp.preprocess import Preprocessor

from segslam.core import geometry
from segslam.core.config import OdometryConfig
from segslam.core.points import is_finite, within_range
from segslam.core.types import BadScan, Motion, Points, Scan, ScanLabels, Trajectory, Transform, Vector
from segslam.labels.label_files import of_rows

PosedScans = Sequence[tuple[Transform, Points]]
"""Poses of scans in the odometry's frame, and their downsampled points."""
STAMP_TOLERANCE_S = 0.01
"""Chosen: largest time difference between a scan and its pose in a given trajectory (s)."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryResult:
    """The pose of a scan and its points."""

    T_odom_lidar: Transform
    """Odom is the frame of the LiDAR at the first scan, so the first pose is the identity."""
    points: Points
    """(n, 3) float32 in the LiDAR frame at this pose; in range; motion-compensated if times are known."""
    labels: ScanLabels
    """(n,) labels, or a function that computes them."""
    intensities: Vector | None = None
    """(n,) intensities; None if unknown."""
    motion: Motion | None = None
    """Result of the check of the motion; None if it was not checked."""
    T_sweep: Transform | None = None
    """Motion during the sweep by which the points were moved to its end; None if they were not moved."""


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

    def follow(self, scans: PosedScans, T_odom_lidar: Transform, T_before_lidar: Transform) -> None:
        """Continue from another pose of the last scan, with a local map of these scans.

        `T_before_lidar`: the motion between the last two scans, per interval of the sensor.
        """
        ...


@runtime_checkable
class Foreseeing(Protocol):
    """An odometry that works on the next scan while the present one is checked."""

    def foresee(self, scan: Scan, *, gap: float) -> None:
        """Begin to register the next scan, `gap` intervals after this one, as if the pose of this one stays."""
        ...


Swept = tuple[Points, ScanLabels, Vector | None]
"""Points (n, 3) float64, their labels and intensities, as `deskew_scan` returns them."""


def deskew_scan(scan: Scan, T_last_lidar: Transform, config: OdometryConfig) -> Swept:
    """Points (n, 3) float64 as measured at the end of the sweep and within range; their labels and intensities.

    Points are cropped after the motion compensation, as in KISS-ICP, which would crop without the labels.
    `T_last_lidar`: motion of the sensor during the sweep.
    """
    points = _at_sweep_end(scan, T_last_lidar, config)
    kept = within_range(points, config.min_range_m, config.max_range_m)
    if not kept.any():
        raise BadScan(
            f"scan {scan.index}: none of its {len(kept)} points lies between {config.min_range_m} and "
            f"{config.max_range_m} m; omit the scan or change odometry.min_range_m, odometry.max_range_m"
        )
    intensities = None if scan.intensities is None else scan.intensities[kept]
    return points.compress(kept, axis=0), of_rows(scan.labels, kept), intensities


def swept_by(scan: Scan, result: OdometryResult, T_sweep: Transform, config: OdometryConfig) -> OdometryResult:
    """The result with the points moved by another motion during the sweep. Raises BadScan as `deskew_scan`."""
    points, labels, intensities = deskew_scan(scan, T_sweep, config)
    return replace(result, points=points.astype(np.float32), labels=labels, intensities=intensities, T_sweep=T_sweep)


def at_stamp(scan: Scan, result: OdometryResult) -> OdometryResult:
    """The result with the pose of the sensor at the stamp of the scan, instead of the end of its sweep."""
    if result.T_sweep is None or scan.stamp_time == 1.0:
        return result
    T_stamp_end = geometry.scaled(result.T_sweep, 1.0 - scan.stamp_time)
    T_odom_stamp = geometry.nearest_transform(result.T_odom_lidar @ geometry.inverse(T_stamp_end))
    points = geometry.apply(T_stamp_end, result.points.astype(np.float64)).astype(np.float32)
    return replace(result, T_odom_lidar=T_odom_stamp, points=points)


def is_swept(scan: Scan, config: OdometryConfig) -> bool:
    """True if the points of a scan are moved to the end of its sweep."""
    return config.deskew and len(scan.times) > 0 and bool(np.ptp(scan.times) > 0)


def _at_sweep_end(scan: Scan, T_last_lidar: Transform, config: OdometryConfig) -> Points:
    """The points as measured at the end of the sweep, if the sensor moves by `T_last_lidar` during it."""
    points = scan.points.astype(np.float64)
    if not is_swept(scan, config):
        return points
    everything = Preprocessor(max_range=np.inf, min_range=-1.0, deskew=True, max_num_threads=config.max_num_threads)
    finite = is_finite(points)  # KISS-ICP drops other points, which would change the order of the rows
    # KISS-ICP normalises the times to the whole sweep; two added points mark its start and end
    marked = np.concatenate([points[finite], np.ones((2, 3))])
    times = np.concatenate([scan.times[finite].astype(np.float64), [0.0, 1.0]])
    points[finite] = everything.preprocess(marked, times, T_last_lidar)[:-2]
    return points


class GivenOdometry:
    """The poses of a given trajectory, relative to the pose of the first registered scan."""

    is_from_scans = False

    def __init__(
        self, trajectory: Trajectory, config: OdometryConfig, *, match: Literal["scan_index", "stamp"] = "scan_index"
    ) -> None:
        """`match`: the pose of a scan is that with its number, or at its stamp (within `STAMP_TOLERANCE_S`)."""
        self._config = config
        self._trajectory = trajectory
        self._rows = {int(scan_index): row for row, scan_index in enumerate(trajectory.scan_index)}
        self._is_by_stamp = match == "stamp"
        self._T_odom_given: Transform | None = None
        """Transform from the frame of the trajectory to the odometry's frame."""
        self._T_given_last = np.eye(4)
        self._T_odom_last = np.eye(4)

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        """The pose and the cropped points of a scan. Raises BadScan if it has no pose, or no point within range."""
        T_given_lidar = self._pose_at_stamp(scan) if self._is_by_stamp else self._pose_of_scan(scan)
        T_odom_given = geometry.inverse(T_given_lidar) if self._T_odom_given is None else self._T_odom_given
        T_odom_lidar = T_odom_given @ T_given_lidar
        T_sweep = self._motion_during(scan)
        if T_sweep is None:
            T_sweep = geometry.scaled(geometry.inverse(self._T_odom_last) @ T_odom_lidar, 1 / gap)
        points, labels, intensities = deskew_scan(scan, T_sweep, self._config)
        self._T_odom_given, self._T_odom_last, self._T_given_last = T_odom_given, T_odom_lidar, T_given_lidar
        moved = T_sweep if is_swept(scan, self._config) else None
        end = OdometryResult(T_odom_lidar, points.astype(np.float32), labels, intensities, T_sweep=moved)
        return replace(at_stamp(scan, end), T_odom_lidar=T_odom_lidar, T_sweep=None)

    def follow(self, scans: PosedScans, T_odom_lidar: Transform, T_before_lidar: Transform) -> None:
        """Continue from another pose of the last scan."""
        self._T_odom_given = T_odom_lidar @ geometry.inverse(self._T_given_last)
        self._T_odom_last = T_odom_lidar

    def _pose_of_scan(self, scan: Scan) -> Transform:
        if scan.index not in self._rows:
            raise BadScan(
                f"scan {scan.index}: the given odometry has no pose for it "
                f"(it has {_span(self._trajectory.scan_index)}); omit the scan or give a longer trajectory"
            )
        return self._trajectory.T_world_lidar[self._rows[scan.index]]

    def _pose_at_stamp(self, scan: Scan) -> Transform:
        T_given_lidar = self._pose_at(scan.stamp_ns)
        if T_given_lidar is None:
            raise BadScan(
                f"scan {scan.index}: the given odometry has no pose within {STAMP_TOLERANCE_S} s of its "
                f"stamp {scan.stamp_ns} ns (it has {_span(self._trajectory.stamp_ns)}); "
                "omit the scan, or correct the stamps"
            )
        return T_given_lidar

    def _motion_during(self, scan: Scan) -> Transform | None:
        """The motion during the sweep; None if its duration or the poses at its start and end are unknown."""
        if not self._is_by_stamp or scan.sweep_s == 0.0:
            return None
        start_ns = scan.stamp_ns - round(1e9 * scan.sweep_s * scan.stamp_time)
        T_given_start, T_given_end = self._pose_at(start_ns), self._pose_at(start_ns + round(1e9 * scan.sweep_s))
        if T_given_start is None or T_given_end is None:
            return None
        return geometry.inverse(T_given_start) @ T_given_end

    def _pose_at(self, stamp_ns: int) -> Transform | None:
        """Between two poses, if there is one within the tolerance on each side; else the nearest one, or None."""
        poses, apart_s = self._trajectory.T_world_lidar, (self._trajectory.stamp_ns - stamp_ns) * 1e-9
        near = np.flatnonzero(np.abs(apart_s) <= STAMP_TOLERANCE_S)
        if len(near) == 0:
            return None
        before, after = near[apart_s[near] < 0.0], near[apart_s[near] >= 0.0]
        if len(before) == 0 or len(after) == 0:
            return poses[near[np.argmin(np.abs(apart_s[near]))]]
        last, following = before[np.argmax(apart_s[before])], after[np.argmin(apart_s[after])]
        if apart_s[following] == 0.0:
            return poses[following]
        share = apart_s[last] / (apart_s[last] - apart_s[following])
        return geometry.interpolate(poses[last], poses[following], share)


def _span(values: np.ndarray) -> str:
    return f"{values.min()} to {values.max()}" if len(values) else "none"
