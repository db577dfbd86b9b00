"""Trajectories of the simulated car: a levelled KITTI trajectory, or a generated loop."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segslam.bench.simulation.levelling import level_revisits, level_world
from segslam.bench.simulation.routes import example_loop
from segslam.core import geometry
from segslam.core.trajectory import Poses, lidar_from_camera, read_poses
from segslam.core.types import SegslamError, Vector
from segslam.scans.dataset import read_stamps
from segslam.scans.kitti import parse_calibration, read_calibration

PERIOD_S = 0.1
# The camera looks along the x axis of the LiDAR: nominal mounting of KITTI's car.
NOMINAL_CALIB = (
    "".join(
        f"P{camera}: 718.856 0 607.1928 {shift} 0 718.856 185.2157 0 0 0 1 0\n"
        for camera, shift in enumerate((0, -386.1448, 45.38225, -337.2877))
    )
    + "Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
)


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """`T_world_lidar` (n, 4, 4): level poses, z up. `time_s` (n,): ascending. `calib`: content of calib.txt."""

    T_world_lidar: Poses
    time_s: Vector
    calib: str


def example_drive(num_frames: int = 0, *, scale: float = 1.0) -> Drive:
    """The generated loop with KITTI's nominal calibration: one round, or several if `num_frames` needs more.

    `scale` enlarges the blocks.
    """
    return Drive(*example_loop(num_frames, scale=scale), NOMINAL_CALIB)


def in_lane(drive: Drive, *, left_m: float = 0.0, reverse: bool = False) -> Drive:
    """A drive along the same streets, `left_m` to the left of the first path, or in the opposite direction."""
    T_world_lidar, time_s = drive.T_world_lidar, drive.time_s
    if reverse:
        T_world_lidar = T_world_lidar[::-1] @ geometry.transform(geometry.yaw(np.pi), np.zeros(3))
        time_s = time_s[0] + time_s[-1] - time_s[::-1]
    return Drive(T_world_lidar @ geometry.transform(np.eye(3), [0.0, left_m, 0.0]), time_s, drive.calib)


def read_drive(poses_file: Path, *, sequence: str) -> Drive:
    """The drive of a KITTI pose file (camera frame), levelled.

    calib.txt and times.txt are searched beside the file, then in ../sequences/NAME where NAME is the name of the file,
    then in ../sequences/`sequence`. Defaults: nominal calibration, 10 Hz.
    Raises SegslamError, naming the file, if one of them is invalid.
    """
    T_world_camera = read_poses(poses_file, format="kitti").T_a_b
    calib_file, times_file = (_beside(poses_file, name, sequence) for name in ("calib.txt", "times.txt"))
    calib = NOMINAL_CALIB
    T_camera_lidar = parse_calibration(calib, Path("calib.txt")) if calib_file is None else read_calibration(calib_file)
    if calib_file is not None:
        calib = calib_file.read_text(encoding="ascii")
    count = len(T_world_camera)
    time_s = np.arange(count) * PERIOD_S
    if times_file is not None:
        time_s = read_stamps(times_file)[:count] / 1e9
        if len(time_s) < count:
            raise SegslamError(f"{times_file}: expected {count} ascending times, one per pose; found {len(time_s)}")
    return Drive(level_revisits(level_world(lidar_from_camera(T_world_camera, T_camera_lidar))), time_s, calib)


def _beside(poses_file: Path, name: str, sequence: str) -> Path | None:
    """The file `name` of the sequence that a pose file belongs to; None if there is none."""
    sequences = poses_file.parent.parent / "sequences"
    folders = (poses_file.parent, sequences / poses_file.stem, sequences / sequence)
    return next((folder / name for folder in folders if (folder / name).is_file()), None)
