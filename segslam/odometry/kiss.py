"""KISS-ICP (Vizzo et al., RA-L 2023), using the package of its authors."""

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol, runtime_checkable

import numpy as np
from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.config.parser import KISSConfig
from kiss_icp.kiss_icp import KissICP

from segslam.core import geometry
from segslam.core.config import OdometryConfig
from segslam.core.types import BadScan, Points, Scan, Transform
from segslam.odometry.motion_model import WINDOW
from segslam.odometry.sweep import OdometryResult, deskew_scan

RESOLUTION = math.sqrt(1.0 / 20.0)
"""Distance between points in KISS-ICP's map, in voxels: at most 20 points a voxel."""


@runtime_checkable
class Aligner(Protocol):
    """Aligns consecutive sweeps with a local map of the previous ones, in this process or in another."""

    def align(self, points: Points, gap: float = 1.0) -> Transform:
        """T_odom_lidar of the next sweep from its points (n, 3), float64, `gap` intervals after the previous one."""
        ...

    def follow(
        self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform, T_before_lidar: Transform
    ) -> None:
        """As `Odometry.follow`."""
        ...

    def align_alone(self, points: Points, gap: float = 1.0) -> None:
        """Align a sweep as well with KISS-ICP as it was before the first `follow`."""
        ...

    def pose_alone(self) -> Transform:
        """The pose of the last sweep passed to `align_alone`."""
        ...

    def rejoin(self) -> None:
        """Continue with KISS-ICP as it was before the first `follow`, which has aligned all sweeps since then."""
        ...


class KissAligner:
    """KISS-ICP's aligner. Its threads sum in any order: poses repeat to 1e-9 m, with one thread exactly."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._kiss = self._first = KissICP(_kiss_config(config))

    def follow(
        self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform, T_before_lidar: Transform
    ) -> None:
        """As `Odometry.follow`: the previous state is discarded."""
        self._kiss = kiss = KissICP(_kiss_config(self._config))
        for T_odom_scan, points in scans:
            kiss.local_map.update(points.astype(np.float64), T_odom_scan)
        kiss.last_pose = np.array(T_odom_lidar)
        kiss.last_delta = np.array(T_before_lidar)

    def align(self, points: Points, gap: float = 1.0) -> Transform:
        """T_odom_lidar of the next sweep from its points (n, 3), float64.

        KISS-ICP predicts with the last motion; here it is scaled to `gap` intervals, and back to one interval
        afterwards.
        """
        return _registered(self._kiss, points, gap)

    def align_alone(self, points: Points, gap: float = 1.0) -> None:
        """As `Aligner.align_alone`."""
        _registered(self._first, points, gap)

    def pose_alone(self) -> Transform:
        """As `Aligner.pose_alone`."""
        return np.array(self._first.last_pose)

    def rejoin(self) -> None:
        """As `Aligner.rejoin`."""
        self._kiss = self._first


def _registered(kiss: KissICP, points: Points, gap: float) -> Transform:
    kiss.last_delta = geometry.scaled(kiss.last_delta, gap)
    kiss.register_frame(points, np.empty(0))
    kiss.last_delta = geometry.scaled(kiss.last_delta, 1 / gap)
    return np.array(kiss.last_pose)


class KissOdometry:
    """Scan-to-map odometry: deskews and crops scans and aligns them, by default with KISS-ICP in this process.

    With `keeps_alone`, KISS-ICP alone aligns each scan after `follow` as well. Once its motions are those of the
    odometry for as many scans as tell what is usual on a drive, it is the odometry again.
    """

    is_from_scans = True

    def __init__(self, config: OdometryConfig, aligner: Aligner | None = None, *, keeps_alone: bool = False) -> None:
        """`keeps_alone`: keep the poses of `alone`."""
        self._config = config
        self._aligner = aligner or KissAligner(config)
        self._keeps_alone = keeps_alone
        self._is_alone, self._is_pending = True, False
        """Whether the odometry is KISS-ICP alone; whether the pose of the last scan by KISS-ICP alone is pending."""
        self._alone: list[Transform] = []
        self._num_equal = 0
        """Number of last motions in which the odometry and KISS-ICP alone do not differ."""
        self._few = np.empty((0, 3))
        self._last_gap = 1.0
        self._T_odom_kiss = self._T_odom_last = self._T_last_lidar = np.eye(4)

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        """The pose and the cropped points of the next scan, in order of time, `gap` intervals after the previous one.

        Raises BadScan, and ignores the scan, if none of its points is within range.
        """
        self._receive_alone()
        points, labels, intensities = deskew_scan(scan, self._T_last_lidar, self._config)
        T_kiss_lidar = self._aligner.align(points, gap)
        T_odom_lidar = self._T_odom_kiss @ T_kiss_lidar
        if self._keeps_alone:
            self._register_alone(scan, points, T_kiss_lidar, gap)
        self._T_last_lidar = geometry.scaled(_since(self._T_odom_last, T_odom_lidar), 1 / gap)
        self._T_odom_last, self._last_gap = T_odom_lidar, gap
        return OdometryResult(T_odom_lidar, points.astype(np.float32), labels, intensities)

    def follow(
        self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform, T_before_lidar: Transform
    ) -> None:
        """Continue from another pose of the last scan, with a local map of these scans alone."""
        self._receive_alone()
        self._is_alone, self._num_equal, self._T_odom_kiss = False, 0, np.eye(4)
        self._aligner.follow(scans, T_odom_lidar, T_before_lidar)
        self._T_odom_last, self._T_last_lidar = T_odom_lidar, T_before_lidar

    def alone(self) -> Sequence[Transform]:
        """The pose of each scan by KISS-ICP alone, without corrections by `follow`; empty if they are not kept."""
        self._receive_alone()
        return self._alone

    def _register_alone(self, scan: Scan, points: Points, T_kiss_lidar: Transform, gap: float) -> None:
        """Keep the pose by KISS-ICP alone; `points` and the pose are those of the scan here."""
        if self._is_alone:
            self._alone.append(T_kiss_lidar)
            return
        with suppress(BadScan):
            points = deskew_scan(scan, self._last_motion_alone(), self._config)[0]
        self._aligner.align_alone(points, gap)
        self._is_pending = True
        self._few = points[:: max(1, len(points) // 500)]

    def _receive_alone(self) -> None:
        """Keep the pending pose by KISS-ICP alone, which is the odometry again once its motions do not differ."""
        if not self._is_pending:
            return
        self._is_pending = False
        self._alone.append(self._aligner.pose_alone())
        T_last_alone = self._last_motion_alone()
        apart_m = geometry.displacement_m(self._few, T_last_alone, self._T_last_lidar)
        self._num_equal = self._num_equal + 1 if apart_m < RESOLUTION * self._config.voxel_size_m else 0
        if self._num_equal == WINDOW:
            self._aligner.rejoin()
            self._is_alone, self._T_last_lidar = True, T_last_alone
            self._T_odom_kiss = geometry.nearest_transform(self._T_odom_last @ geometry.inverse(self._alone[-1]))

    def _last_motion_alone(self) -> Transform:
        before, last = [np.eye(4), np.eye(4), *self._alone[-2:]][-2:]
        return geometry.scaled(_since(before, last), 1 / self._last_gap)


def _since(T_odom_last: Transform, T_odom_lidar: Transform) -> Transform:
    """The relative motion, inverted as in KISS-ICP: bitwise equal results."""
    T_last_lidar: Transform = np.linalg.inv(T_odom_last) @ T_odom_lidar
    return T_last_lidar


def _kiss_config(config: OdometryConfig) -> KISSConfig:
    """The configuration of KISS-ICP with all sections: it would read missing ones from the environment."""
    return KISSConfig(
        data=DataConfig(max_range=config.max_range_m, min_range=config.min_range_m, deskew=False),
        mapping=MappingConfig(voxel_size=config.voxel_size_m),
        registration=RegistrationConfig(max_num_threads=config.max_num_threads),
        adaptive_threshold=AdaptiveThresholdConfig(),
    )
