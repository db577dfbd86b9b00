"""KISS-ICP (Vizzo et al., RA-L 2023), using the package of its authors."""

from contextlib import suppress

import numpy as np
from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.config.parser import KISSConfig

from segslam.core import geometry
from segslam.core.config import OdometryConfig
from segslam.core.types import BadScan, Points, Scan, Transform
from segslam.odometry.aligner import KissAligner
from segslam.odometry.sweep import OdometryResult, PosedScans, Swept, deskew_scan, is_swept


class KissOdometry:
    """Scan-to-map odometry: deskews and crops scans and aligns them, by default with KISS-ICP in this process."""

    is_from_scans = True

    def __init__(
        self, config: OdometryConfig, aligner: KissAligner | None = None, *, keeps_alone: bool = False
    ) -> None:
        """`keeps_alone`: keep the poses of `alone`, for which each scan is aligned twice after the first `follow`."""
        self._config = config
        self._aligner = aligner or KissAligner(kiss_config(config))
        self._keeps_alone, self._has_followed = keeps_alone, False
        self._T_sweep_alone: Transform | None = None
        """Motion during the sweep of the next scan, if its pose by KISS-ICP alone is kept already."""
        self._T_end_stamp: list[Transform] = []
        """Pose of the sensor at the stamp of each scan of `alone`, in that at the end of its sweep."""
        self._last_gap = 1.0
        self._T_odom_last = self._T_last_lidar = np.eye(4)

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        """The pose and the cropped points of the next scan, in order of time, `gap` intervals after the previous one.

        Raises BadScan, and ignores the scan, if none of its points is within range.
        """
        (points, labels, intensities), T_odom_lidar = self._aligned(scan, gap)
        if self._keeps_alone:
            self._register_alone(scan, points, T_odom_lidar, gap)
        T_sweep = self._T_last_lidar if is_swept(scan, self._config) else None
        self._T_last_lidar = geometry.scaled(_since(self._T_odom_last, T_odom_lidar), 1 / gap)
        self._T_odom_last = T_odom_lidar
        return OdometryResult(T_odom_lidar, points.astype(np.float32), labels, intensities, T_sweep=T_sweep)

    def _aligned(self, scan: Scan, gap: float) -> tuple[Swept, Transform]:
        """The points of the next scan, and its pose."""
        swept = deskew_scan(scan, self._T_last_lidar, self._config)
        return swept, self._aligner.align(swept[0], geometry.scaled(self._T_last_lidar, gap))

    def follow(self, scans: PosedScans, T_odom_lidar: Transform, T_before_lidar: Transform) -> None:
        """Continue from another pose of the last scan, with a local map of these scans alone."""
        self._has_followed = True
        self._aligner.follow(scans, T_odom_lidar)
        self._T_odom_last, self._T_last_lidar = T_odom_lidar, T_before_lidar

    def alone(self) -> list[Transform]:
        """The pose at the stamp of each scan by KISS-ICP alone, without corrections by `follow`; empty if not kept."""
        ends = self._aligner.alone()  # perhaps with that of the next scan
        return [T_odom_end @ T_end for T_odom_end, T_end in zip(ends, self._T_end_stamp, strict=False)]

    def _register_alone(self, scan: Scan, points: Points, T_odom_lidar: Transform, gap: float) -> None:
        """Keep the pose by KISS-ICP alone; `points` and the pose are those of the scan here."""
        if not self._has_followed:
            T_sweep = self._T_last_lidar
            self._aligner.keep(T_odom_lidar)
        elif self._T_sweep_alone is not None:
            T_sweep, self._T_sweep_alone = self._T_sweep_alone, None
        else:
            before, last = [np.eye(4), np.eye(4), *self._aligner.alone()[-2:]][-2:]
            T_sweep = geometry.scaled(_since(before, last), 1 / self._last_gap)
            with suppress(BadScan):
                points = deskew_scan(scan, T_sweep, self._config)[0]
            self._aligner.align_alone(points, geometry.scaled(T_sweep, gap))
        self._last_gap = gap
        share = 1.0 - scan.stamp_time if is_swept(scan, self._config) else 0.0
        self._T_end_stamp.append(geometry.inverse(geometry.scaled(T_sweep, share)))


def _since(T_odom_last: Transform, T_odom_lidar: Transform) -> Transform:
    """The relative motion, inverted as in KISS-ICP: bitwise equal results."""
    T_last_lidar: Transform = np.linalg.inv(T_odom_last) @ T_odom_lidar
    return T_last_lidar


def kiss_config(config: OdometryConfig) -> KISSConfig:
    """The configuration of KISS-ICP with all sections: it would read missing ones from the environment."""
    return KISSConfig(
        data=DataConfig(max_range=config.max_range_m, min_range=config.min_range_m, deskew=False),
        mapping=MappingConfig(voxel_size=config.voxel_size_m),
        registration=RegistrationConfig(max_num_threads=config.max_num_threads),
        adaptive_threshold=AdaptiveThresholdConfig(),
    )
