"""Submaps (the cloud of a keyframe merged with those of its neighbours), and the pairs of them to register.

Pairs lie along the drive at several distances, and between passes of one place.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from segslam.candidates.places import OTHER_PLACE_M
from segslam.candidates.proximity import HEIGHT_M, Covariances
from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.points import voxel_means
from segslam.core.probabilities import SIGNIFICANT
from segslam.core.trajectory import Poses
from segslam.core.types import IndexPairs, Indices, Points, Transform, Vector
from segslam.keyframes import is_known
from segslam.registration.refinement import LightSurface, downsample
from segslam.slam.adjustment.alignment import SEARCH_M, Alignment, PointsOf, align

REACH = 2
"""Chosen on KITTI 00: number of keyframes before and after one that are in its submap."""
MOST_SUBMAPS = 20
"""Chosen: submaps in memory, about 1.5 MB each; a drive needs 6, and 2 more for each other pass beside it. With 16 a
sixth more were made for four simulated drives of one town; with 64 as many as with 20."""
EVERY = 2
"""Chosen on KITTI 00: a submap is registered for every n-th keyframe."""
STEPS = (5, 10)
"""Chosen on KITTI 00: distances of registered submaps along the drive, in keyframes."""

Aligned = Callable[[int, int, Transform], Alignment | None]
"""The alignment of a target and a source, by their ids, near an initial guess."""


def surfaces_of(
    points_of: PointsOf, T_world: Poses, motion_variance: Vector, *, config: RefineConfig
) -> Callable[[int], LightSurface]:
    """Returns the surface of a submap by the id of its keyframe, in its frame; made when needed, and kept for a while.

    `motion_variance`: as of `is_known`. No object here refers to itself, so that the submaps are freed at once when the
    function is no longer needed. The keyframe's own points stay exactly the same: their coordinates are often multiples
    of a millimetre, and would be rounded from the border of a voxel to either side.
    """

    @lru_cache(MOST_SUBMAPS * (2 * REACH + 1))  # those of the submaps in memory
    def scan(keyframe_id: int) -> Points:
        return downsample(points_of(keyframe_id), config=config).astype(np.float64)

    @lru_cache(MOST_SUBMAPS)
    def submap(keyframe_id: int) -> LightSurface:
        T_keyframe_world = geometry.inverse(T_world[keyframe_id])
        near = members(keyframe_id, motion_variance, most_m=config.voxel_m)
        others = [geometry.apply(T_keyframe_world @ T_world[one], scan(one)) for one in near if one != keyframe_id]
        return LightSurface(voxel_means(np.vstack([scan(keyframe_id), *others]), config.voxel_m))

    return submap


def aligned_by(surface_of: Callable[[int], LightSurface]) -> Aligned:
    """Returns the alignment of two submaps near an initial guess."""
    return lambda target_id, source_id, T_guess: align(surface_of(source_id), surface_of(target_id), T_guess)


def members(keyframe_id: int, motion_variance: Vector, *, most_m: float) -> list[int]:
    """The keyframes of a submap: up to `REACH` before and after one, if motions between err by less than `most_m`."""
    near = range(max(0, keyframe_id - REACH), min(len(motion_variance), keyframe_id + REACH + 1))
    return [other for other in near if is_known(motion_variance, keyframe_id, other, within_m=most_m)]


def all_pairs(T_world: Poses, travel_m: Vector, covariances: Covariances, *, min_travel_m: float) -> IndexPairs:
    """(k, 2) target (older) and source of all pairs, sorted by source, so that near rows share submaps.

    A pair whose pose may be off by more than `SEARCH_M`, with a probability of `SIGNIFICANT`, is left out: an alignment
    ends at the surfaces that are nearest, and would confirm the error.
    """
    passes = pairs_between_passes(T_world, travel_m, min_travel_m=min_travel_m)
    pairs = np.vstack([pairs_along(len(travel_m)), passes])
    pairs = np.unique(pairs[:, ::-1], axis=0)[:, ::-1]
    between = (covariances(source, np.array([target]))[0] for target, source in pairs.tolist())
    is_sure = [geometry.chance_beyond(SEARCH_M[0], covariance) < SIGNIFICANT for covariance in between]
    return pairs[np.array(is_sure, dtype=bool)]


def pairs_along(num_keyframes: int) -> IndexPairs:
    """(k, 2) target (older) and source of pairs along the drive."""
    nodes = _nodes(num_keyframes)
    pairs = np.vstack([np.column_stack([nodes, nodes + step]) for step in STEPS])
    return pairs[pairs[:, 1] < num_keyframes]


def pairs_between_passes(T_world: Poses, travel_m: Vector, *, min_travel_m: float) -> IndexPairs:
    """(k, 2) target (older) and source of pairs of two passes of one place, at least `min_travel_m` of travel apart.

    Each node is paired with the nearest node of each earlier pass that shows the same place (`OTHER_PLACE_M`).
    """
    nodes = _nodes(len(travel_m))
    places = T_world[nodes, :3, 3]
    near = cKDTree(places[:, :2]).query_ball_point(places[:, :2], OTHER_PLACE_M)
    pairs = []
    for row, rows in enumerate(near):
        older = np.array(sorted(other for other in rows if other < row), dtype=np.int64)
        older = older[travel_m[nodes[row]] - travel_m[nodes[older]] >= min_travel_m]
        older = older[np.abs(places[older, 2] - places[row, 2]) < HEIGHT_M]
        for one in np.split(older, 1 + np.flatnonzero(np.diff(travel_m[nodes[older]]) >= min_travel_m)):
            if len(one):
                nearest = one[np.argmin(np.linalg.norm(places[one] - places[row], axis=1))]
                pairs.append((nodes[nearest], nodes[row]))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _nodes(num_keyframes: int) -> Indices:
    return np.arange(0, num_keyframes, EVERY)
