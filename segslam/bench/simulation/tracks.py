"""Trajectories of the simulated car: a KITTI trajectory in which each place gets one height, or a generated loop."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core import geometry
from segslam.core.pose_files import read_poses
from segslam.core.trajectory import Poses, lidar_from_camera
from segslam.core.types import SegslamError, Vector
from segslam.core.whole_files import read_text
from segslam.scans.dataset import read_stamps
from segslam.scans.kitti import parse_calibration

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
STATION_M = 1.0  # chosen: spacing along the path at which heights are solved for
REVISIT_M = 4.0  # chosen: two visits nearer than this are on one road
REVISIT_GAP_M = 30.0  # chosen: least travel between two visits of one place
TIE_WEIGHT = 0.03  # chosen: the visits in the 11 KITTI sequences then agree to a few centimetres
TENSION_M = 10.0  # chosen: prevents the correction from overshooting the differences it removes
MAX_SLOPE = 0.2  # chosen: steeper than any street of the data


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """`T_world_lidar` (n, 4, 4): level poses, z up. `time_s` (n,): ascending. `calib`: content of calib.txt."""

    T_world_lidar: Poses
    time_s: Vector
    calib: str


def example_drive(num_frames: int = 0, *, scale: float = 1.0) -> Drive:
    """A generated drive at 10 Hz with KITTI's nominal calibration that revisits a street in both directions.

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
    moments = np.arange(0.0, max(time[len(lane) + shared], num_frames * PERIOD_S), PERIOD_S)
    xy, ahead = (
        np.column_stack([np.interp(moments + later, time, path[:, axis]) for axis in (0, 1)]) for later in (0.0, 0.02)
    )
    return Drive(_poses(xy, ahead - xy), moments, NOMINAL_CALIB)


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
    calib = NOMINAL_CALIB if calib_file is None else read_text(calib_file, "calibration", "put KITTI's calib.txt there")
    T_camera_lidar = parse_calibration(calib, calib_file or Path("calib.txt"))
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
    tangent = geometry.unit_rows(np.gradient(np.concatenate([smooth[-1:], smooth, smooth[:1]]), axis=0)[1:-1])
    return smooth + LANE_M * np.column_stack([tangent[:, 1], -tangent[:, 0]])


def _height_m(xy: np.ndarray) -> Vector:
    """Height of gentle hills at each position."""
    return 0.8 * np.sin(xy[:, 0] / 31.0) + 0.6 * np.sin(xy[:, 1] / 23.0 + 0.7)


def _poses(xy: np.ndarray, forward: np.ndarray) -> Poses:
    """Poses on the hills, with x along the road."""
    ahead = geometry.unit_rows(forward)
    x = geometry.unit_rows(np.column_stack([ahead, _height_m(xy + ahead) - _height_m(xy)]))
    y = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(x))])
    return geometry.transforms(np.stack([x, y, np.cross(x, y)], axis=-1), np.column_stack([xy, _height_m(xy)]))


def level_world(T_world_lidar: Poses) -> Poses:
    """The drive in a frame with z along the mean up direction of the sensor. It starts at the origin; yaw is kept."""
    up = T_world_lidar[:, :3, 2].mean(axis=0)
    up /= np.linalg.norm(up)
    turn = geometry.level(up)
    from_start = T_world_lidar[:, :3, 3] - T_world_lidar[0, :3, 3]
    return geometry.transforms(turn @ T_world_lidar[:, :3, :3], from_start @ turn.T)


def level_revisits(T_world_lidar: Poses) -> Poses:
    """The drive with one height for each place; x, y and yaw are unchanged. z must point up.

    The heights of two visits to one place differ in real ground truth, by up to metres. The correction removes the
    difference with the smallest change of slope; each pose is pitched to its new slope.
    """
    positions = T_world_lidar[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
    travel = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-6))])  # ascends strictly, also where the car stands
    bound = MAX_SLOPE * np.diff(travel)
    climb = np.concatenate([[0.0], np.cumsum(np.clip(np.diff(positions[:, 2]), -bound, bound))])
    stations = np.arange(0.0, travel[-1] + STATION_M, STATION_M)
    path = np.column_stack([np.interp(stations, travel, values) for values in (*positions[:, :2].T, climb)])
    raise_m = _smoothest_raise(path)
    slope = np.gradient(raise_m, STATION_M) if len(stations) > 1 else np.zeros(1)
    left = geometry.unit_rows(np.cross([0.0, 0.0, 1.0], T_world_lidar[:, :3, 0]))
    pitches = -np.arctan(np.interp(travel, stations, slope))
    turns = ScipyRotation.from_rotvec(pitches[:, None] * left).as_matrix()
    at = np.column_stack([positions[:, :2], climb + np.interp(travel, stations, raise_m)])
    return geometry.transforms(turns @ T_world_lidar[:, :3, :3], at)


def _smoothest_raise(path: np.ndarray) -> Vector:
    """(n,) correction r of the heights h of a path with rows STATION_M apart; each revisited place gets one height.

    Minimises sum (r'' s^2)^2 + sum (r' s^2 / TENSION_M)^2 + TIE_WEIGHT sum (h_i + r_i - h_j - r_j)^2, where s is
    STATION_M, and j is a point, interpolated between two rows, of an earlier visit.
    """
    count = len(path)
    ties = _ties(path[:, :2])
    if ties.shape[0] == 0:
        return np.zeros(count)
    curvature = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 2, count))
    tension = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count - 1, count)) * (STATION_M / TENSION_M)
    normal = curvature.T @ curvature + tension.T @ tension + TIE_WEIGHT * (ties.T @ ties)
    anchored = normal + 1e-12 * diags_array(np.ones(count))  # the cost ignores a common offset: keep it near zero
    return spsolve(anchored.tocsc(), -TIE_WEIGHT * (ties.T @ (ties @ path[:, 2])))


def _ties(path_xy: np.ndarray) -> csr_array:
    """(k, n) sparse matrix: each row subtracts the point of an earlier visit from the point of the path beside it."""
    pairs = cKDTree(path_xy).query_pairs(REVISIT_M, output_type="ndarray").reshape(-1, 2)
    early, late = pairs[pairs[:, 1] - pairs[:, 0] > REVISIT_GAP_M / STATION_M].T
    step = path_xy[early + 1] - path_xy[early]
    share = np.einsum("ij,ij->i", path_xy[late] - path_xy[early], step) / np.einsum("ij,ij->i", step, step)
    beside = (share >= 0.0) & (share < 1.0)
    early, late, share = early[beside], late[beside], share[beside]
    row = np.arange(len(share))
    columns = np.concatenate([late, early, early + 1])
    values = np.concatenate([np.ones(len(share)), share - 1.0, -share])
    return csr_array((values, (np.tile(row, 3), columns)), shape=(len(share), len(path_xy)))
