"""Trajectories of the simulated car: a levelled KITTI trajectory, or a generated loop."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from segslam.bench.simulation.levelling import level_revisits, level_world
from segslam.core import geometry
from segslam.core.trajectory import Poses, lidar_from_camera, read_poses
from segslam.core.types import SegslamError, Vector
from segslam.scans.dataset import read_stamps
from segslam.scans.kitti import parse_calibration, read_calibration

# The camera looks along the x axis of the LiDAR: nominal mounting of KITTI's car.
NOMINAL_CALIB = (
    "".join(
        f"P{camera}: 718.856 0 607.1928 {shift} 0 718.856 185.2157 0 0 0 1 0\n"
        for camera, shift in enumerate((0, -386.1448, 45.38225, -337.2877))
    )
    + "Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
)

# Two blocks that share the street from (0, 0) to (40, 0). It is driven eastwards, westwards after the eastern block,
# and eastwards again after the western block. The round then repeats.
CORNERS_M = ((0, 0), (40, 0), (40, 33), (74, 33), (74, 0), (0, 0), (-33, 0), (-33, -32), (0, -32), (0, 0))
SHARED_M = 40.0
STEP_M = 0.25
LANE_M = 1.4  # chosen: offset of the car to the right of the street's centre line
TURN_M = 5.0  # chosen: width of the Gaussian that rounds the corners
SPEED_M_S, TURN_M_S2, PERIOD_S = 14.0, 5.0, 0.1  # chosen: top speed; lateral acceleration that limits speed in turns


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


def example_loop(num_frames: int = 0, *, scale: float = 1.0) -> tuple[Poses, Vector]:
    """Poses T_world_lidar (n, 4, 4) and times (n,) (s) of a drive at 10 Hz that revisits a street in both directions.

    The drive is one round and the shared street again, about 300 scans, or `num_frames` scans if that is more. `scale`
    enlarges the blocks.
    """
    corners = scale * np.array(CORNERS_M, dtype=float)
    ends = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    stations = np.arange(0.0, ends[-1], STEP_M)
    lane = _rounded(np.column_stack([np.interp(stations, ends, corners[:, axis]) for axis in (0, 1)]))
    shared = int(scale * SHARED_M / STEP_M)
    rounds = 1 + int(np.ceil(num_frames * SPEED_M_S * PERIOD_S / ends[-1]))
    path = np.tile(lane, (rounds + 1, 1))
    time = np.concatenate([[0.0], np.cumsum(_seconds(path))])
    enough = max(time[len(lane) + shared], num_frames * PERIOD_S) if num_frames else time[len(lane) + shared]
    moments = np.arange(0.0, enough, PERIOD_S)
    xy, ahead = (
        np.column_stack([np.interp(moments + later, time, path[:, axis]) for axis in (0, 1)]) for later in (0.0, 0.02)
    )
    return _poses(xy, ahead - xy), moments


def _seconds(path: np.ndarray) -> Vector:
    """(n - 1,) time (s) from point to point, longer in turns."""
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    turns = np.abs(np.gradient(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])))) / lengths
    bend = gaussian_filter1d(turns, TURN_M / STEP_M, mode="nearest")
    return lengths / np.minimum(SPEED_M_S, np.sqrt(TURN_M_S2 / np.maximum(bend, 1e-9)))


def _rounded(street: np.ndarray) -> np.ndarray:
    """The right lane of a closed street, with rounded corners."""
    smooth = gaussian_filter1d(street, TURN_M / STEP_M, axis=0, mode="wrap")
    tangent = np.gradient(np.concatenate([smooth[-1:], smooth, smooth[:1]]), axis=0)[1:-1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return smooth + LANE_M * np.column_stack([tangent[:, 1], -tangent[:, 0]])


def _height_m(xy: np.ndarray) -> Vector:
    """Height of gentle hills at each position."""
    return 0.8 * np.sin(xy[:, 0] / 31.0) + 0.6 * np.sin(xy[:, 1] / 23.0 + 0.7)


def _poses(xy: np.ndarray, forward: np.ndarray) -> Poses:
    """Poses on the hills, with x along the road."""
    ahead = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    slope = _height_m(xy + ahead) - _height_m(xy)
    x = np.column_stack([ahead, slope])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(x))])
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=-1)
    poses[:, :3, 3] = np.column_stack([xy, _height_m(xy)])
    return poses
