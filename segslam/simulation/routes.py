"""A made-up drive through a few blocks, for those who have no trajectory at hand."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from segslam.trajectory import Poses
from segslam.types import Vector

# Two blocks that share the street from (0, 0) to (70, 0): driven eastwards, then westwards after the eastern block, and
# eastwards again when all starts over after the western block.
CORNERS_M = ((0, 0), (70, 0), (70, 48), (120, 48), (120, 0), (0, 0), (-52, 0), (-52, -40), (0, -40))
LANE_M = 1.6  # chosen: the car keeps to the right of the street's middle
TURN_M = 4.0  # chosen: corners are rounded by a Gaussian of this width
SPEED_M_S, PERIOD_S = 12.0, 0.1


def made_up_loop(num_frames: int | None = None) -> tuple[Poses, Vector]:
    """(T_world_lidar, seconds) of a drive at 10 Hz with a street driven in both directions and again in the first.

    One round unless a number of frames is asked for; more than one round repeats it.
    """
    corners = np.array([*CORNERS_M, CORNERS_M[0]], dtype=float)
    lengths = np.abs(np.diff(corners, axis=0)).sum(axis=1)
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    steps = np.arange(0.0, ends[-1], 0.25)
    street = np.column_stack([np.interp(steps, ends, corners[:, axis]) for axis in (0, 1)])
    lane = _rounded(street)
    travel = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lane, axis=0, append=lane[:1]), axis=1))])
    count = int(travel[-1] / (SPEED_M_S * PERIOD_S)) if num_frames is None else num_frames
    closed = np.concatenate([lane, lane[:1]])
    at = np.arange(count) * SPEED_M_S * PERIOD_S
    xy = np.column_stack([np.interp(at % travel[-1], travel, closed[:, axis]) for axis in (0, 1)])
    ahead = np.column_stack([np.interp((at + 0.5) % travel[-1], travel, closed[:, axis]) for axis in (0, 1)])
    return _poses(xy, ahead - xy), np.arange(count) * PERIOD_S


def _rounded(street: np.ndarray) -> np.ndarray:
    """The right lane of a closed street, corners rounded."""
    smooth = gaussian_filter1d(street, TURN_M / 0.25, axis=0, mode="wrap")
    tangent = np.gradient(np.concatenate([smooth[-1:], smooth, smooth[:1]]), axis=0)[1:-1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return smooth + LANE_M * np.column_stack([tangent[:, 1], -tangent[:, 0]])


def _height_m(xy: np.ndarray) -> Vector:
    """Gentle hills, so that slopes are not nothing."""
    return 0.8 * np.sin(xy[:, 0] / 31.0) + 0.6 * np.sin(xy[:, 1] / 23.0 + 0.7)


def _poses(xy: np.ndarray, forward: np.ndarray) -> Poses:
    """Poses upon the hills, x along the road."""
    ahead = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    slope = _height_m(xy + ahead) - _height_m(xy)
    x = np.column_stack([ahead, slope])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(x))])
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=-1)
    poses[:, :3, 3] = np.column_stack([xy, _height_m(xy)])
    return poses
