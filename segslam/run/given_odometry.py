"""`segslam map --odometry`: a trajectory from a file instead of KISS-ICP."""

from pathlib import Path
from typing import TYPE_CHECKING

from segslam.core.errors import SegslamError

if TYPE_CHECKING:
    from segslam.core.config import OdometryConfig
    from segslam.odometry import Odometry
    from segslam.scans import Dataset


def given_odometry(file: Path, scans: "Dataset", config: "OdometryConfig") -> "Odometry":
    """Odometry from a file. TUM rows are matched by stamp; KITTI rows by scan number, or position among mapped scans.

    Raises SegslamError unless the number of KITTI rows is that of all scans of the data or of the mapped scans.
    """
    import numpy as np

    from segslam.core.trajectory import read_poses
    from segslam.core.types import Trajectory
    from segslam.odometry import GivenOdometry

    poses = read_poses(file)
    if poses.stamp_ns is not None:
        trajectory = Trajectory(np.arange(len(poses)), poses.stamp_ns, poses.T_a_b)
        return GivenOdometry(trajectory, config, match="stamp")
    by_number = len(poses) == scans.num_recorded
    if not by_number and len(poses) != len(scans):
        numbers = dict.fromkeys((scans.num_recorded, len(scans)))
        raise SegslamError(
            f"{file}: {len(poses)} poses, but {scans.name} has {' or '.join(map(str, numbers))}; KITTI format needs "
            "one line per scan, TUM format is matched by stamp"
        )
    rows = np.arange(len(poses)) if by_number else scans.scan_index
    return GivenOdometry(Trajectory(rows, np.zeros(len(poses), dtype=np.int64), poses.T_a_b), config)
