"""Detection of vertical surfaces: points along one line in the x-y plane that reach high enough."""

import numpy as np
from scipy.ndimage import maximum_filter

from segslam.core.kernels import kernel
from segslam.core.types import Mask, Points, Vector
from segslam.labels.solids import grid_cells

CELL_M = 0.6
"""Chosen, like the next constants, by the IoU of buildings on the real KITTI scans 0-2 (`tools/benchmarks/labels`)."""
LAYER_M = 2.0
NUM_LAYERS = 5
MIN_LENGTH_M = 0.3
"""Smallest standard deviation along the line."""
MIN_POINTS = 8


def on_walls(points: Points, heights: Vector, *, thickness_m: float, min_top_m: float) -> Mask:
    """(n,) bool: whether each point lies on a vertical surface, for points in a level frame.

    Each voxel is tested with its 8 neighbours: the standard deviation of the points perpendicular to their line must be
    below `thickness_m`, and one of the points must be higher than `min_top_m` above the ground.
    """
    cells, corner, shape = grid_cells(points, CELL_M, border=1)
    layers = np.clip(heights / LAYER_M, 0, NUM_LAYERS - 1).astype(np.int64)
    voxel, moments = _moments(points, layers, cells, corner, (NUM_LAYERS, *shape))
    top = np.full(shape, -np.inf)
    np.maximum.at(top.ravel(), cells[:, 0] * shape[1] + cells[:, 1], heights)
    tall = maximum_filter(top, 3) >= min_top_m
    walls = _walls(voxel, moments, tall, thickness_m * 1000, MIN_LENGTH_M * 1000)
    return walls[voxel[layers, cells[:, 0], cells[:, 1]]]


@kernel(
    "Tuple((int32[:, :, ::1], int64[:, ::1]))(float64[:, ::1], int64[::1], int64[:, ::1], float64[::1],"
    "UniTuple(int64, 3))"
)
def _moments(points, layers, cells, corner, shape):
    """Index of each occupied voxel (-1 elsewhere), and the sums of 1, x, y, xx, xy, yy over the points of each voxel.

    The sums are in integer millimetres and do not depend on the order of the points.
    """
    voxel = np.full(shape, -1, np.int32)
    moments = np.zeros((len(layers), 6), np.int64)
    num_voxels = 0
    for k in range(len(layers)):
        layer, i, j = layers[k], cells[k, 0], cells[k, 1]
        if voxel[layer, i, j] < 0:
            voxel[layer, i, j] = num_voxels
            num_voxels += 1
        x = int(np.round((points[k, 0] - corner[0]) * 1000))
        y = int(np.round((points[k, 1] - corner[1]) * 1000))
        m = moments[voxel[layer, i, j]]
        m[0] += 1
        m[1] += x
        m[2] += y
        m[3] += x * x
        m[4] += x * y
        m[5] += y * y
    return voxel, moments[:num_voxels]


@kernel("boolean[::1](int32[:, :, ::1], int64[:, ::1], boolean[:, ::1], float64, float64)")
def _walls(voxel, moments, tall, thickness_mm, min_length_mm):
    """True for each voxel that is part of a vertical surface. Neighbours are within the grid, whose border is empty."""
    walls = np.zeros(len(moments), np.bool_)
    total = np.zeros(6, np.int64)
    for layer in range(voxel.shape[0]):
        for i in range(1, voxel.shape[1] - 1):
            for j in range(1, voxel.shape[2] - 1):
                if voxel[layer, i, j] < 0 or not tall[i, j]:
                    continue
                total[:] = 0
                for a in range(i - 1, i + 2):
                    for b in range(j - 1, j + 2):
                        if voxel[layer, a, b] >= 0:
                            for m in range(6):
                                total[m] += moments[voxel[layer, a, b], m]
                walls[voxel[layer, i, j]] = _is_line(total, thickness_mm, min_length_mm)
    return walls


@kernel("boolean(int64[::1], float64, float64)")
def _is_line(moments, thickness_mm, min_length_mm):
    n, x, y = moments[0], moments[1], moments[2]
    xx, xy, yy = moments[3], moments[4], moments[5]
    if n < MIN_POINTS:
        return False
    a, b, c = xx / n - (x / n) ** 2, xy / n - (x / n) * (y / n), yy / n - (y / n) ** 2
    middle, spread = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
    return middle - spread < thickness_mm**2 and middle + spread > min_length_mm**2
