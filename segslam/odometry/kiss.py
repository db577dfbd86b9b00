"""KISS-ICP (Vizzo et al., RA-L 2023), by its authors' package."""

from collections.abc import Callable

import numpy as np
from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.config.parser import KISSConfig
from kiss_icp.kiss_icp import KissICP

from segslam.config import OdometryConfig
from segslam.odometry.sweep import OdometryResult, prepare
from segslam.trajectory import Poses
from segslam.types import Scan


class KissOdometry:
    """KISS-ICP, scan to local map. Several threads add up in any order: poses repeat to 1e-9 m, on one to the bit."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._kiss = KissICP(_kiss_config(config))

    def register(self, scan: Scan) -> OdometryResult:
        """The pose and the kept points of the next scan, in order of time.

        Raises BadScan, and forgets the scan, if none of its points is within range.
        """
        points, labels, intensities = prepare(scan, self._kiss.last_delta, self._config)
        self._kiss.register_frame(points, np.empty(0))
        return OdometryResult(np.array(self._kiss.last_pose), points.astype(np.float32), labels, intensities)

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
                points, *_ = prepare(scan_of(row), kiss.last_delta, self._config)
                kiss.local_map.update(kiss.voxelize(points)[1], T_odom_now)
            T_odom_predicted = kiss.last_pose @ kiss.last_delta
            kiss.adaptive_threshold.update_model_deviation(np.linalg.inv(T_odom_predicted) @ T_odom_now)
            kiss.last_delta = np.linalg.inv(kiss.last_pose) @ T_odom_now  # inverted as by KISS-ICP: same bits
            kiss.last_pose = T_odom_now


def _kiss_config(config: OdometryConfig) -> KISSConfig:
    """Every section is given: KISS-ICP would read a missing one from the environment."""
    return KISSConfig(
        data=DataConfig(max_range=config.max_range_m, min_range=config.min_range_m, deskew=False),
        mapping=MappingConfig(voxel_size=config.voxel_size_m),
        registration=RegistrationConfig(max_num_threads=config.max_num_threads),
        adaptive_threshold=AdaptiveThresholdConfig(),
    )
