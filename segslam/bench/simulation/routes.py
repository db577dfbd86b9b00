"""A generated drive through a few blocks, used if no trajectory is given."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from segslam.core.trajectory import Poses
from segslam.core.types import Vector

# Two blocks that share the street from (0, 0) to (40, 0). It is driven eastwards, westwards after the eastern block,
# and eastwards again after the western block. The round then repeats.
CORNERS_M = ((0, 0), (40, 0), (40, 33), (74, 33), (74, 0), (0, 0), (-33, 0), (-33, -32), (0, -32), (0, 0))
SHARED_M = 40.0
STEP_M = 0.25
LANE_M = 1.4  # chosen: offset of the car to the right of the street's centre line
TURN_M = 5.0  # chosen: width of the Gaussian that rounds the corners
SPEED_M_S, TURN_M_S2, PERIOD_S = 14.0, 5.0, 0.1  # chosen: top speed; lateral acceleration that limits speed in turns


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
