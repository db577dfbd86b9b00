"""One height for each place: a measured trajectory made fit to build a street on.

Real ground truth gives two visits of one place different heights, up to metres. Here heights change by the least change
of slope that removes this, and each pose pitches with its new slope.
"""

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.trajectory import Poses
from segslam.types import Vector

STEP_M = 1.0  # chosen: heights are solved for at this spacing of the path
REVISIT_M = 4.0  # chosen: two visits this near are on one road
REVISIT_GAP_M = 30.0  # chosen: less travel than this between them is no second visit
TIE_WEIGHT = 0.03  # chosen: visits of the 11 KITTI sequences then agree to some centimetres
TENSION_M = 10.0  # chosen: keeps the raise from swinging beyond the gaps it closes
MAX_SLOPE = 0.2  # chosen: above that of the streets of the data


def upright(T_world_lidar: Poses) -> Poses:
    """The same drive in a world whose z is the mean up of the sensor, first position at the origin, heading kept."""
    up = T_world_lidar[:, :3, 2].mean(axis=0)
    up /= np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    turn = ScipyRotation.from_rotvec(axis / max(sine, 1e-12) * np.arctan2(sine, up[2])).as_matrix()
    poses = T_world_lidar.copy()
    poses[:, :3, :3] = turn @ T_world_lidar[:, :3, :3]
    poses[:, :3, 3] = (T_world_lidar[:, :3, 3] - T_world_lidar[0, :3, 3]) @ turn.T
    return poses


def level(T_world_lidar: Poses) -> Poses:
    """The drive with one height for each place; x, y and heading are untouched. Expects z to point up."""
    positions = T_world_lidar[:, :3, 3]
    travel = _travel_m(positions)
    climb = np.concatenate([[0.0], np.cumsum(_plausible_climbs(positions, travel))])
    stations = np.arange(0.0, travel[-1] + STEP_M, STEP_M)
    path = np.column_stack([np.interp(stations, travel, values) for values in (*positions[:, :2].T, climb)])
    raise_m = _smoothest_raise(path)
    slope = np.gradient(raise_m, STEP_M) if len(stations) > 1 else np.zeros(1)
    heights = climb + np.interp(travel, stations, raise_m)
    return _raised(T_world_lidar, heights, np.interp(travel, stations, slope))


def _plausible_climbs(positions: np.ndarray, travel_m: Vector) -> Vector:
    """(n - 1,) height gained from pose to pose, no steeper than a street: a standing car does not rise."""
    bound = MAX_SLOPE * np.diff(travel_m)
    return np.clip(np.diff(positions[:, 2]), -bound, bound)


def _smoothest_raise(path: np.ndarray) -> Vector:
    """(n,) raise r of a path of heights h, STEP_M between its rows, that gives each revisited place one height.

    Minimises sum (r'' STEP_M^2)^2 + sum (r' STEP_M^2 / TENSION_M)^2 + ties sum (h_i + r_i - h_j - r_j)^2, where j is a
    point between two rows of an earlier visit.
    """
    count = len(path)
    ties = _ties(path[:, :2])
    if ties.shape[0] == 0:
        return np.zeros(count)
    curvature = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 2, count))
    tension = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count - 1, count)) * (STEP_M / TENSION_M)
    normal = curvature.T @ curvature + tension.T @ tension + TIE_WEIGHT * (ties.T @ ties)
    anchored = normal + 1e-12 * diags_array(np.ones(count))  # a common raise of all changes nothing: keep it small
    return spsolve(anchored.tocsc(), -TIE_WEIGHT * (ties.T @ (ties @ path[:, 2])))


def _ties(path_xy: np.ndarray) -> csr_array:
    """(k, n) sparse: each row takes a point of the path minus the point of an earlier visit right beside it."""
    pairs = cKDTree(path_xy).query_pairs(REVISIT_M, output_type="ndarray").reshape(-1, 2)
    early, late = pairs[pairs[:, 1] - pairs[:, 0] > REVISIT_GAP_M / STEP_M].T
    step = path_xy[early + 1] - path_xy[early]
    share = np.einsum("ij,ij->i", path_xy[late] - path_xy[early], step) / np.einsum("ij,ij->i", step, step)
    beside = (share >= 0.0) & (share < 1.0)
    early, late, share = early[beside], late[beside], share[beside]
    row = np.arange(len(share))
    columns = np.concatenate([late, early, early + 1])
    values = np.concatenate([np.ones(len(share)), share - 1.0, -share])
    return csr_array((values, (np.tile(row, 3), columns)), shape=(len(share), len(path_xy)))


def _raised(T_world_lidar: Poses, heights: Vector, slope: Vector) -> Poses:
    """Each pose at its height, and pitched about its own level left so that it climbs by `slope` more."""
    forward = T_world_lidar[:, :3, 0]
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    turns = ScipyRotation.from_rotvec(-np.arctan(slope)[:, None] * left).as_matrix()
    poses = T_world_lidar.copy()
    poses[:, :3, :3] = turns @ T_world_lidar[:, :3, :3]
    poses[:, 2, 3] = heights
    return poses


def _travel_m(positions: np.ndarray) -> Vector:
    """Travel in the plane; a standing car advances by a hair so that the values ascend."""
    steps = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-6))])
