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
from segslam.types import IndexPairs, Vector

STEP_M = 1.0  # chosen: heights are solved for at this spacing of the path
REVISIT_M = 4.0  # chosen: two visits this near are on one road
REVISIT_GAP_M = 30.0  # chosen: less travel than this between them is no second visit
TIE_WEIGHT = 1.0  # chosen: against changes of slope per STEP_M; visits then agree to about a centimetre


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
    stations = np.arange(0.0, travel[-1] + STEP_M, STEP_M)
    path = np.column_stack([np.interp(stations, travel, positions[:, axis]) for axis in range(3)])
    raise_m = _smoothest_raise(path[:, 2], revisits(path[:, :2]))
    slope = np.gradient(raise_m, STEP_M) if len(stations) > 1 else np.zeros(1)
    return _raised(T_world_lidar, np.interp(travel, stations, raise_m), np.interp(travel, stations, slope))


def revisits(path_xy: np.ndarray) -> IndexPairs:
    """Rows (i, j), i < j, of a path with STEP_M between rows: j a later visit of the place of i, its nearest."""
    pairs = cKDTree(path_xy).query_pairs(REVISIT_M, output_type="ndarray").reshape(-1, 2)
    return pairs[pairs[:, 1] - pairs[:, 0] > REVISIT_GAP_M / STEP_M]


def _smoothest_raise(heights: Vector, pairs: IndexPairs) -> Vector:
    """Minimises sum (second difference of r)^2 + ties sum (h_i + r_i - h_j - r_j)^2, r itself kept near 0."""
    count = len(heights)
    if len(pairs) == 0:
        return np.zeros(count)
    curvature = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 2, count))
    rows = np.repeat(np.arange(len(pairs)), 2)
    ties = csr_array((np.tile([1.0, -1.0], len(pairs)), (rows, pairs.ravel())), shape=(len(pairs), count))
    gap = heights[pairs[:, 1]] - heights[pairs[:, 0]]
    normal = curvature.T @ curvature + TIE_WEIGHT * (ties.T @ ties) + 1e-9 * diags_array(np.ones(count))
    return spsolve(normal.tocsc(), TIE_WEIGHT * (ties.T @ gap))


def _raised(T_world_lidar: Poses, raise_m: Vector, slope: Vector) -> Poses:
    """Each pose lifted, and pitched about its own level left so that it climbs by `slope` more."""
    forward = T_world_lidar[:, :3, 0]
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    turns = ScipyRotation.from_rotvec(-np.arctan(slope)[:, None] * left).as_matrix()
    poses = T_world_lidar.copy()
    poses[:, :3, :3] = turns @ T_world_lidar[:, :3, :3]
    poses[:, 2, 3] += raise_m
    return poses


def _travel_m(positions: np.ndarray) -> Vector:
    """Travel in the plane; a standing car advances by a hair so that the values ascend."""
    steps = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-6))])
