"""Removal of moving objects: voxels that more keyframes see through than observe.

Each keyframe has a range image: the range of the nearest point in each direction. A map point is compared with the
range images of all keyframes near it. A keyframe confirms the point if its range is similar, sees through the point
if its range is clearly larger, and gives no information if its range is smaller. Visibility as in Pomerleau et al.,
"Long-term 3D map maintenance in dynamic environments" (ICRA 2014); range images as in Kim and Kim, "Remove, then
Revert" (IROS 2020).
"""

import math
from collections.abc import Iterable

import numpy as np
from scipy.spatial import cKDTree

from segslam.core.config import MapConfig
from segslam.core.kernels import kernel
from segslam.core.types import GROUND_LABELS, Labels, Mask, Points, Transform

VIEW_MARGIN_M = 0.3
"""Chosen: distance by which a return must lie behind a voxel to have passed through it (m)."""
VIEW_MARGIN_RATIO = 0.01
"""Chosen: increase of that distance per metre of range."""
MIN_VIEWS = 3
"""Chosen: smallest number of keyframes that see through a removed voxel."""
MOVED_RADIUS_M = 0.8
"""Chosen: voxels with mostly removed neighbours within this radius are removed too (m)."""
CELL_RAD = math.radians(0.5)
"""Chosen: the beams of a 64-beam sensor are 0.4 degrees apart."""
NUM_COLUMNS = 720
NUM_ROWS = 180
"""45 degrees down to 45 degrees up."""
STEP_M = 0.01
NOTHING = 65535
"""Value of a pixel without points, i.e. unknown. Ranges are multiples of STEP_M, at most 655 m."""
MIN_RANGE_M = 1.0
MAX_SPREAD_CELLS = 12
"""Largest number of pixels that a near point covers to each side."""


@kernel("UniTuple(float64, 3)(float64, float64, float64)")
def _direction(x, y, z):
    """Row and column, as fractions, and range."""
    across = math.sqrt(x * x + y * y)
    row = math.atan2(z, across) / CELL_RAD + NUM_ROWS / 2
    column = (math.atan2(y, x) + math.pi) / CELL_RAD
    return row, column, math.sqrt(across * across + z * z)


@kernel("uint16[:, :](float32[:, :], float64)")
def nearest_returns(points, spread_m):
    """(NUM_ROWS, NUM_COLUMNS) range image in units of STEP_M of the points of a keyframe, in its own frame.

    Each point covers all pixels within `spread_m` of it, because keyframes are downsampled.
    """
    nearest = np.full((NUM_ROWS, NUM_COLUMNS), NOTHING, np.uint16)
    for x, y, z in points:
        row, column, distance = _direction(x, y, z)
        if distance < MIN_RANGE_M or distance >= NOTHING * STEP_M:
            continue
        steps = np.uint16(distance / STEP_M)
        spread = min(max(spread_m / distance / CELL_RAD, 0.5), MAX_SPREAD_CELLS)
        for i in range(max(int(row - spread), 0), min(int(row + spread), NUM_ROWS - 1) + 1):
            for j in range(math.floor(column - spread), math.floor(column + spread) + 1):
                nearest[i, j % NUM_COLUMNS] = min(nearest[i, j % NUM_COLUMNS], steps)
    return nearest


@kernel("void(float32[:, :], float64[:, :], uint16[:, :], float64[:], uint32[:, :])")
def count_votes(points, T_view_points, nearest, limits, votes):
    """Add the votes of one range image to `votes`: confirmations in column 0, views through a point in column 1.

    `limits`: largest distance of a point from the keyframe (m); tolerance of its range, constant (m) and per metre.
    """
    T = T_view_points
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if a * a + b * b + c * c > limits[0] * limits[0]:
            continue
        row, column, distance = _direction(a, b, c)
        if row < 0 or row >= NUM_ROWS or distance < MIN_RANGE_M:
            continue
        seen = nearest[int(row), int(column) % NUM_COLUMNS]
        margin = limits[1] + limits[2] * distance
        if seen != NOTHING and seen * STEP_M > distance + margin:
            votes[i, 1] += 1
        elif seen != NOTHING and seen * STEP_M > distance - margin:
            votes[i, 0] += 1


def moved(points: Points, labels: Labels, views: Iterable[tuple[np.ndarray, Transform]], *, config: MapConfig) -> Mask:
    """(n,) bool: whether each point belongs to an object that has moved.

    `views`: range images of keyframes, each with its T_view_points. A point has moved if at least `min_views`
    keyframes, and more than observed it, see through it; or if most of its neighbours have moved. Points of the ground
    never move, and do not count as neighbours: rays at grazing incidence pass close above them.
    """
    stays = np.isin(labels, np.array(GROUND_LABELS, np.uint8))
    votes = np.zeros((len(points), 2), np.uint32)
    limits = np.array([config.view_range_m, VIEW_MARGIN_M, VIEW_MARGIN_RATIO])
    for nearest, T_view_points in views:
        count_votes(points, T_view_points, nearest, limits, votes)
    confirmed, seen_through = votes.T
    has_moved = (seen_through >= MIN_VIEWS) & (seen_through > confirmed) & ~stays
    doubtful = np.flatnonzero(~stays & ~has_moved)
    if not has_moved.any() or not len(doubtful):
        return has_moved
    trees = cKDTree(points[has_moved]), cKDTree(points[doubtful])
    nearest_m, _ = trees[0].query(points[doubtful], distance_upper_bound=MOVED_RADIUS_M)
    near = doubtful[np.isfinite(nearest_m)]
    num_moved, num_others = (tree.query_ball_point(points[near], MOVED_RADIUS_M, return_length=True) for tree in trees)
    has_moved[near] = num_moved > num_others - 1  # a point is not its own neighbour
    return has_moved
