"""Removal of moving objects: voxels that more keyframes see through than observe."""

from collections.abc import Iterable

import numpy as np
from scipy.spatial import cKDTree

from segslam.core.config import MapConfig
from segslam.core.types import GROUND_LABELS, Labels, Mask, Points, Transform
from segslam.output.map.views import count_votes

VIEW_MARGIN_M = 0.3
"""Chosen: distance by which a return must lie behind a voxel to have passed through it (m)."""
VIEW_MARGIN_RATIO = 0.01
"""Chosen: increase of that distance per metre of range."""
MIN_VIEWS = 3
"""Chosen: smallest number of keyframes that see through a removed voxel."""
MOVED_RADIUS_M = 0.8
"""Chosen: voxels with mostly removed neighbours within this radius are removed too (m)."""


def moved(points: Points, labels: Labels, views: Iterable[tuple[np.ndarray, Transform]], *, config: MapConfig) -> Mask:
    """(n,) bool: whether each point belongs to an object that has moved.

    `views`: range images of keyframes, each with its T_view_points. A point has moved if at least `min_views`
    keyframes, and more than observed it, see through it; or if most of its neighbours have moved. Points of the ground
    never move: rays at grazing incidence pass close above them.
    """
    stays = np.isin(labels, np.array(GROUND_LABELS, np.uint8))
    votes = np.zeros((len(points), 2), np.uint32)
    limits = np.array([config.view_range_m, VIEW_MARGIN_M, VIEW_MARGIN_RATIO])
    for nearest, T_view_points in views:
        count_votes(points, T_view_points, nearest, limits, votes)
    confirmed, seen_through = votes.T
    has_moved = (seen_through >= MIN_VIEWS) & (seen_through > confirmed) & ~stays
    return has_moved | _among_moved(points, has_moved, stays, MOVED_RADIUS_M)


def _among_moved(points: Points, has_moved: Mask, stays: Mask, radius_m: float) -> Mask:
    """Points that may move and have more moved than other neighbours; points of the ground do not count."""
    doubtful = np.flatnonzero(~stays & ~has_moved)
    among = np.zeros(len(points), bool)
    if not has_moved.any() or not len(doubtful):
        return among
    moved_tree = cKDTree(points[has_moved])
    nearest_m, _ = moved_tree.query(points[doubtful], distance_upper_bound=radius_m)
    doubtful = doubtful[np.isfinite(nearest_m)]
    num_moved = moved_tree.query_ball_point(points[doubtful], radius_m, return_length=True)
    others = cKDTree(points[~stays & ~has_moved]).query_ball_point(points[doubtful], radius_m, return_length=True)
    among[doubtful] = num_moved > others - 1  # a point is not its own neighbour
    return among
