"""Poses as arrays, matching of their rows, and the poses of all scans from the poses of keyframes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core import geometry
from segslam.core.errors import brief
from segslam.core.types import IndexPairs, Indices, Mask, SegslamError, Transform, Vector

Poses = Float[np.ndarray, "_ 4 4"]
"""Rigid transforms T_a_b, one per row."""
ROTATION_TOLERANCE = 0.01  # chosen: above the rounding in files, far below the error of other matrices
LARGEST = float(np.finfo(np.float32).max)
"""Largest number of a pose or a graph: a point has no larger coordinates, and products of larger ones overflow."""
NOT_FINITE = f"every number must be finite, at most {LARGEST:.2g}"


class Rows:
    """An array that grows by rows of one shape. Arrays returned by `all` do not change: rows are only appended."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows
        self._num = len(rows)

    def __len__(self) -> int:
        return self._num

    def append(self, row: np.ndarray | float) -> None:
        """Add a row; amortised constant time."""
        if self._num == len(self._rows):
            longer = np.empty((max(16, 2 * self._num), *self._rows.shape[1:]), self._rows.dtype)
            longer[: self._num] = self._rows
            self._rows = longer
        self._rows[self._num] = row
        self._num += 1

    def all(self) -> np.ndarray:
        """A read-only view of the rows so far."""
        view = self._rows[: self._num]
        view.flags.writeable = False
        return view


def as_poses(given: object, name: str) -> Poses:
    """Poses of an array-like object, (n, 4, 4). Raises SegslamError, with the name, for anything else."""
    try:
        poses = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SegslamError(f"{name}: {brief(str(given))} is no array; give finite matrices, (n, 4, 4)") from error
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not (np.abs(poses) <= LARGEST).all():
        raise SegslamError(f"{name}: poses of shape {poses.shape}; give finite matrices, (n, 4, 4)")
    off = np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0)
    if len(poses) and max(off, from_matrices(poses[:, :3])[1].max()) > ROTATION_TOLERANCE:
        raise SegslamError(f"{name}: a matrix is not a pose: a rotation and a translation, then the row 0 0 0 1")
    return poses


def camera_from_lidar(T_world_lidar: Poses, T_camera_lidar: Transform) -> Poses:
    """LiDAR poses as KITTI stores them: poses of the camera in the frame of the first camera."""
    return T_camera_lidar @ T_world_lidar @ geometry.inverse(T_camera_lidar)


def lidar_from_camera(T_world_camera: Poses, T_camera_lidar: Transform) -> Poses:
    """LiDAR poses in the frame of the first, from poses as KITTI stores them; undoes `camera_from_lidar`."""
    return geometry.inverse(T_camera_lidar) @ T_world_camera @ T_camera_lidar


def rows_of_same_stamp(stamp_ns_a: Indices, stamp_ns_b: Indices, *, max_difference_ns: int) -> IndexPairs:
    """Rows (of a, of b) that are mutually nearest in time and at most `max_difference_ns` apart; ascending in a."""
    if len(stamp_ns_a) == 0 or len(stamp_ns_b) == 0:
        return np.empty((0, 2), dtype=np.int64)
    nearest_b = nearest_rows(stamp_ns_b, stamp_ns_a)
    nearest_a = nearest_rows(stamp_ns_a, stamp_ns_b)
    rows_a = np.arange(len(stamp_ns_a))
    mutual = nearest_a[nearest_b] == rows_a
    close = np.abs(stamp_ns_b[nearest_b] - stamp_ns_a) <= max_difference_ns
    return np.column_stack([rows_a, nearest_b])[mutual & close]


def rows_of_same_scan(scan_index_a: Indices, scan_index_b: Indices) -> IndexPairs:
    """Rows (of a, of b) of the same scan, ascending in the scan's number."""
    _, rows_a, rows_b = np.intersect1d(scan_index_a, scan_index_b, return_indices=True)
    return np.column_stack([rows_a, rows_b])


def travelled_m(T_a_b: Poses, begun: Indices | Sequence[int] = ()) -> np.ndarray:
    """(n,) length of the path from the first pose to each pose (m), without the ways to those of the rows `begun`."""
    steps = np.linalg.norm(np.diff(T_a_b[:, :3, 3], axis=0), axis=1)
    steps[[row - 1 for row in begun if 0 < row < len(T_a_b)]] = 0.0
    return np.concatenate([np.zeros(min(1, len(T_a_b))), np.cumsum(steps)])


def begun_among(rows: Indices, begun: Indices) -> Indices:
    """The rows among some scans, themselves `rows`, before which another drive begins."""
    firsts = np.unique(np.searchsorted(rows, begun))
    return firsts[(firsts > 0) & (firsts < len(rows))]


def parted(values: np.ndarray, begun: Indices | Sequence[int]) -> np.ndarray:
    """Values (n, ...) with one of NaN before each of these rows: a line through them is drawn with gaps there."""
    return np.insert(values.astype(np.float64), np.asarray(begun, np.int64), np.nan, axis=0)


def corrected_poses(
    T_odom_lidar: Poses, keyframe_rows: Indices, T_world_keyframe: Poses, *, after_break: Mask | None = None
) -> Poses:
    """T_world_lidar of every scan, from the odometry of every scan and the corrected poses of the keyframes.

    The keyframes before and after a scan each predict its pose by the odometry between them. The two predictions are
    blended on SE(3) by the share of the way travelled. Only the nearest keyframe is used before the first and after the
    last, and only the keyframe before if the next one follows a break (`after_break`, one value per keyframe).
    `keyframe_rows` must ascend. Raises ValueError without keyframes, or for another number of poses.
    """
    if len(keyframe_rows) == 0 or len(keyframe_rows) != len(T_world_keyframe):
        raise ValueError(f"{len(keyframe_rows)} keyframes and {len(T_world_keyframe)} poses of keyframes")
    corrections = [
        T_world_k @ geometry.inverse(T_odom_lidar[row])
        for row, T_world_k in zip(keyframe_rows, T_world_keyframe, strict=True)
    ]
    before, after, share = _surroundings(keyframe_rows, travelled_m(T_odom_lidar))
    if after_break is not None:
        share = np.where(after_break[after], 0.0, share)
    poses = [
        geometry.interpolate(corrections[k] @ T_odom_s, corrections[m] @ T_odom_s, fraction)
        for T_odom_s, k, m, fraction in zip(T_odom_lidar, before, after, share, strict=True)
    ]
    T_world_lidar = np.array(poses)
    T_world_lidar[keyframe_rows] = T_world_keyframe
    return T_world_lidar


def _surroundings(keyframe_rows: Indices, travel_m: np.ndarray) -> tuple[Indices, Indices, np.ndarray]:
    """For each scan: the keyframe before it, the one after it, and the share of the way between them, 0 to 1."""
    rows = np.arange(len(travel_m))
    last = len(keyframe_rows) - 1
    position = np.searchsorted(keyframe_rows, rows, side="right")
    before, after = np.clip(position - 1, 0, last), np.clip(position, 0, last)
    standing = 1e-9 * rows  # where the sensor does not move, the share is that of the scans
    progress = travel_m + standing
    start, end = progress[keyframe_rows[before]], progress[keyframe_rows[after]]
    share = (progress - start) / np.where(before == after, 1.0, end - start)
    return before, after, np.clip(share, 0.0, 1.0)


def nearest_rows(values: np.ndarray, targets: np.ndarray) -> Indices:
    """(n,) row of the value that is nearest to each target, the smaller one of two; there is a value at least."""
    order = np.argsort(values, kind="stable")
    ascending = values[order]
    right = np.clip(np.searchsorted(ascending, targets), min(1, len(values) - 1), len(values) - 1)
    left = np.maximum(right - 1, 0)
    closer_left = np.abs(ascending[left] - targets) <= np.abs(ascending[right] - targets)
    return order[np.where(closer_left, left, right)]


def from_matrices(rows: np.ndarray) -> tuple[Poses, Vector]:
    """The poses, and the distance of each 3x3 part from a rotation."""
    matrices = rows.reshape(-1, 3, 4)
    rotations = np.array([geometry.nearest_rotation(matrix) for matrix in matrices[:, :, :3]])
    off = np.abs(matrices[:, :, :3] - rotations).max(axis=(1, 2))
    return geometry.transforms(rotations, matrices[:, :, 3]), off


def from_quaternions(rows: np.ndarray) -> tuple[Poses, Vector]:
    """The poses of rows (n, 7) x y z qx qy qz qw, and the difference of each quaternion's length from 1."""
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    quaternions = np.where(norms[:, None] > 0, rows[:, 3:], [0.0, 0.0, 0.0, 1.0])  # zeros are then rejected
    poses = geometry.transforms(ScipyRotation.from_quat(quaternions).as_matrix(), rows[:, :3])
    return poses, np.abs(norms - 1.0)
