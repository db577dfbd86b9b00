"""Where a simulated car goes: along a KITTI trajectory, made level, or round a made-up loop."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segslam import geometry
from segslam.simulation.levelling import level, upright
from segslam.simulation.routes import made_up_loop
from segslam.trajectory import Poses, lidar_from_camera, read_poses
from segslam.types import SegslamError, Transform, Vector

PERIOD_S = 0.1
# The camera looks along the LiDAR's x; nominal mounting of KITTI's car.
NOMINAL_CALIB = (
    "".join(
        f"P{camera}: 718.856 0 607.1928 {shift} 0 718.856 185.2157 0 0 0 1 0\n"
        for camera, shift in enumerate((0, -386.1448, 45.38225, -337.2877))
    )
    + "Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
)


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """`T_world_lidar` (n, 4, 4) level, z up; `time_s` (n,) ascending; `calib` the text of calib.txt."""

    T_world_lidar: Poses
    time_s: Vector
    calib: str


def made_up_drive(num_frames: int = 0) -> Drive:
    """The made-up loop with KITTI's nominal calibration: one round, or more if it takes more to fill so many scans."""
    return Drive(*made_up_loop(num_frames), NOMINAL_CALIB)


def read_drive(poses_file: Path, *, sequence: str) -> Drive:
    """The drive of a KITTI pose file (camera frame), made level.

    calib.txt and times.txt are sought beside the file, then in ../sequences/NAME for the file's own name, then for
    `sequence`; without calib the nominal one is used, without times 10 Hz.
    Raises SegslamError that names the file if one is broken.
    """
    folders = [poses_file.parent] + [
        poses_file.parent.parent / "sequences" / name for name in (poses_file.stem, sequence)
    ]
    calib_file = next((folder / "calib.txt" for folder in folders if (folder / "calib.txt").is_file()), None)
    calib = NOMINAL_CALIB if calib_file is None else calib_file.read_text()
    T_camera_lidar = parse_calib(calib, source=str(calib_file))
    T_world_camera = read_poses(poses_file, format="kitti").T_a_b
    count = len(T_world_camera)
    times_file = next((folder / "times.txt" for folder in folders if (folder / "times.txt").is_file()), None)
    time_s = np.arange(count) * PERIOD_S if times_file is None else _times(times_file, count)
    T_world_lidar = level(upright(lidar_from_camera(T_world_camera, T_camera_lidar)))
    return Drive(T_world_lidar, time_s, calib)


def parse_calib(text: str, *, source: str) -> Transform:
    """T_camera_lidar, the line `Tr`. Raises SegslamError that names the source."""
    for line in text.splitlines():
        name, _, values = line.partition(":")
        if name.strip() in ("Tr", "Tr_velo_to_cam"):
            numbers = np.fromstring(values, sep=" ")
            if numbers.shape == (12,) and np.isfinite(numbers).all():
                rows = numbers.reshape(3, 4)
                return geometry.transform(geometry.nearest_rotation(rows[:, :3]), rows[:, 3])
    raise SegslamError(f"{source}: no line `Tr:` with 12 numbers; take calib.txt from the KITTI odometry data")


def _times(path: Path, count: int) -> Vector:
    try:
        times = np.loadtxt(path, ndmin=1)
    except (OSError, ValueError) as error:
        raise SegslamError(f"{path}: cannot read the times ({error}); give a number of seconds a line") from error
    if len(times) < count or not (np.diff(times) > 0).all():
        raise SegslamError(f"{path}: needs {count} ascending times for as many poses, holds {len(times)}")
    return times[:count]
