"""Corrects a measured trajectory so that each place has one height; streets can then be built along it.

The heights of two visits to one place differ in real ground truth, by up to metres. The correction removes the
difference with the smallest change of slope; each pose is pitched to its new slope.
"""

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Vector

STEP_M = 1.0  # chosen: spacing along the path at which heights are solved for
REVISIT_M = 4.0  # chosen: two visits nearer than this are on one road
REVISIT_GAP_M = 30.0  # chosen: least travel between two visits of one place
TIE_WEIGHT = 0.03  # chosen: the visits in the 11 KITTI sequences then agree to a few centimetres
TENSION_M = 10.0  # chosen: prevents the correction from overshooting the differences it removes
MAX_SLOPE = 0.2  # chosen: steeper than any street of the data


def level_world(T_world_lidar: Poses) -> Poses:
    """The drive in a frame with z along the mean up direction of the sensor. It starts at the origin; yaw is kept."""
    up = T_world_lidar[:, :3, 2].mean(axis=0)
    up /= np.linalg.norm(up)
    turn = geometry.level(up)
    poses = T_world_lidar.copy()
    poses[:, :3, :3] = turn @ T_world_lidar[:, :3, :3]
    poses[:, :3, 3] = (T_world_lidar[:, :3, 3] - T_world_lidar[0, :3, 3]) @ turn.T
    return poses


def level_revisits(T_world_lidar: Poses) -> Poses:
    """The drive with one height for each place; x, y and yaw are unchanged. z must point up."""
    positions = T_world_lidar[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
    travel = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-6))])  # ascends strictly, also where the car stands
    bound = MAX_SLOPE * np.diff(travel)
    climb = np.concatenate([[0.0], np.cumsum(np.clip(np.diff(positions[:, 2]), -bound, bound))])
    stations = np.arange(0.0, travel[-1] + STEP_M, STEP_M)
    path = np.column_stack([np.interp(stations, travel, values) for values in (*positions[:, :2].T, climb)])
    raise_m = _smoothest_raise(path)
    slope = np.gradient(raise_m, STEP_M) if len(stations) > 1 else np.zeros(1)
    heights = climb + np.interp(travel, stations, raise_m)
    return _raised(T_world_lidar, heights, np.interp(travel, stations, slope))


def _smoothest_raise(path: np.ndarray) -> Vector:
    """(n,) correction r of the heights h of a path with rows STEP_M apart; each revisited place gets one height.

    Minimises sum (r'' STEP_M^2)^2 + sum (r' STEP_M^2 / TENSION_M)^2 + TIE_WEIGHT sum (h_i + r_i - h_j - r_j)^2, where j
    is a point, interpolated between two rows, of an earlier visit.
    """
    count = len(path)
    ties = _ties(path[:, :2])
    if ties.shape[0] == 0:
        return np.zeros(count)
    curvature = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 2, count))
    tension = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count - 1, count)) * (STEP_M / TENSION_M)
    normal = curvature.T @ curvature + tension.T @ tension + TIE_WEIGHT * (ties.T @ ties)
    anchored = normal + 1e-12 * diags_array(np.ones(count))  # the cost ignores a common offset: keep it near zero
    return spsolve(anchored.tocsc(), -TIE_WEIGHT * (ties.T @ (ties @ path[:, 2])))


def _ties(path_xy: np.ndarray) -> csr_array:
    """(k, n) sparse matrix: each row subtracts the point of an earlier visit from the point of the path beside it."""
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
    """Each pose moved to its height and pitched about its left axis, so that the slope increases by `slope`."""
    forward = T_world_lidar[:, :3, 0]
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    turns = ScipyRotation.from_rotvec(-np.arctan(slope)[:, None] * left).as_matrix()
    poses = T_world_lidar.copy()
    poses[:, :3, :3] = turns @ T_world_lidar[:, :3, :3]
    poses[:, 2, 3] = heights
    return poses
