"""Submaps: the cloud of a keyframe merged with those of its neighbours along the drive, as a surface."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from segslam.candidates.proximity import BREAK_TRAVEL_M
from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.points import voxel_means
from segslam.core.trajectory import Poses
from segslam.core.types import Points, Transform, Vector
from segslam.registration.refinement import LightSurface, downsample
from segslam.slam.adjustment.alignment import Alignment, align

REACH = 2
"""Chosen on KITTI 00: number of keyframes before and after one that are in its submap."""

PointsOf = Callable[[int], Points]
"""Returns the points of a keyframe, by id, in its own frame."""

MOST_SUBMAPS = 16
"""Chosen: submaps in memory, about 1.5 MB each; a drive needs 6, and 2 more for each other pass beside it."""


class Submaps:
    """Submaps by the id of their keyframe, in its frame, made when they are needed."""

    def __init__(
        self,
        points_of: PointsOf,
        T_world: Poses,
        travel_m: Vector,
        *,
        config: RefineConfig,
    ) -> None:
        self._points_of, self._T_world, self._travel_m = points_of, T_world, travel_m
        self._refine = config
        self._scan = lru_cache(MOST_SUBMAPS * (2 * REACH + 1))(self._scan_of)  # those of the submaps in memory
        self.submap = lru_cache(MOST_SUBMAPS)(self._submap)

    def aligned(self, target_id: int, source_id: int, T_target_source: Transform) -> Alignment | None:
        """The alignment of two submaps near an initial guess."""
        return align(self.submap(source_id), self.submap(target_id), T_target_source)

    def _scan_of(self, keyframe_id: int) -> Points:
        return downsample(self._points_of(keyframe_id), config=self._refine).astype(np.float64)

    def _submap(self, keyframe_id: int) -> LightSurface:
        T_keyframe_world = geometry.inverse(self._T_world[keyframe_id])
        near = members(keyframe_id, self._travel_m, reach=REACH)
        points = np.vstack([geometry.apply(T_keyframe_world @ self._T_world[one], self._scan(one)) for one in near])
        return LightSurface(voxel_means(points, self._refine.voxel_m))


def members(keyframe_id: int, travel_m: Vector, *, reach: int) -> list[int]:
    """The keyframes of a submap: up to `reach` before and after one, without those beyond a break."""
    near = range(max(0, keyframe_id - reach), min(len(travel_m), keyframe_id + reach + 1))
    return [other for other in near if abs(travel_m[other] - travel_m[keyframe_id]) < BREAK_TRAVEL_M]
