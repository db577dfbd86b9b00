"""What hangs over the sensor's path: ceilings and roofs, which hide a building in top view."""

from collections.abc import Iterable

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from segslam.core.types import Points, Vector

Window = tuple[float, float, float, float]
"""West, east, south and north end of a top view (m)."""
BESIDE_M = 0.5
"""Chosen: a point within this horizontal distance of a keyframe's position, above it, hangs over it."""
LOWEST_M = 0.5
"""Chosen: what is nearer above the sensor is its mount or its operator."""
NEIGHBOURS = 11
"""Chosen: number of keyframes along the path of which most must be covered."""
SHARE = 0.5
"""Of the way from the sensor up to what hangs over it: where the picture is cut."""


def cut_heights(path_m: Points, clouds: Iterable[Points]) -> Vector:
    """Height (n,) in the world (m) above which points near each position of the path hide the picture; inf: none do.

    The sensor has passed through free space, and the lowest point above a position ends this space. Where most of the
    neighbouring positions have such a point, the sensor drove below a ceiling, and points higher than half way up to it
    are cut. Below the open sky, trees and wires hang over few positions: over 1 % of the real KITTI 00, so that nothing
    is cut; over 100 % of a roofed courtyard. An avenue whose trees meet above the path (17 keyframes of
    NCLT) is cut like a ceiling. `clouds`: the points (k, 3) of the map in the world, in any pieces.
    """
    tree = cKDTree(path_m[:, :2])
    free_m = np.full(len(path_m), np.inf)
    lowest_m = path_m[:, 2].min()
    for cloud in clouds:
        points = cloud[cloud[:, 2] > lowest_m]  # most are ground
        away_m, row = tree.query(points[:, :2], distance_upper_bound=BESIDE_M)
        beside = np.isfinite(away_m)
        above_m = points[beside, 2] - path_m[row[beside], 2]
        over = above_m > LOWEST_M
        np.minimum.at(free_m, row[beside][over], above_m[over])
    covered = np.isfinite(free_m)
    inside = uniform_filter1d(covered.astype(float), NEIGHBOURS, mode="nearest") > 0.5
    if not inside.any():
        return np.full(len(path_m), np.inf)
    _, nearest = cKDTree(path_m[covered]).query(path_m)
    return np.where(inside, path_m[:, 2] + SHARE * free_m[covered][nearest], np.inf)


def visible(points: Points, path_m: Points, cut_m: Vector) -> np.ndarray:
    """(k,) True for points that are not above the cut of the nearest position of the path."""
    if not np.isfinite(cut_m).any():
        return np.ones(len(points), bool)
    _, nearest = cKDTree(path_m[:, :2]).query(points[:, :2])
    return points[:, 2] <= cut_m[nearest]
