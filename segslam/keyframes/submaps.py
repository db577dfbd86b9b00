"""Clouds of keyframes for matching: sparse clouds are merged with those of neighbouring keyframes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from segslam.candidates.proximity import BREAK_TRAVEL_M
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import Labels, Points, Transform, Vector
from segslam.keyframes.keyframes import Clouds
from segslam.registration import refinement
from segslam.registration.prepared import Labeller, PreparedScan, prepare_scan

DENSE_VOXELS = 3000
"""Chosen on KITTI, courtyard, NCLT: a keyframe with fewer voxels (refine.voxel_m) is matched together with its
neighbours' points."""
MAX_GATHERED = 10
"""Chosen: largest number of neighbouring keyframes whose points are merged."""


@dataclass(frozen=True, slots=True, eq=False)
class Submap:
    """Points and labels in the frame of a keyframe; `seen_from_here`: the keyframe's own points."""

    points: Points
    labels: Labels
    seen_from_here: Points


class Submaps:
    """Submaps of the keyframes of a drive, computed on use."""

    def __init__(
        self, config: Config, clouds: Callable[[], Clouds], labeller: Labeller, travel_m: Callable[[], Vector]
    ) -> None:
        """`clouds` and `travel_m` provide points and travel of keyframes by id; `labeller`: geometric labels."""
        self._config, self._clouds, self._labeller, self._travel_m = config, clouds, labeller, travel_m
        self._by_shape: set[int] = set()
        self.T_odom: list[Transform] = []
        """Poses of the keyframes, by id, in any frame in which neighbours have the correct relative pose."""

    def add(self, T_odom_keyframe: Transform, *, labelled_by_shape: bool) -> None:
        """Add the newest keyframe."""
        if labelled_by_shape:
            self._by_shape.add(len(self.T_odom))
        self.T_odom.append(T_odom_keyframe)

    def submap(self, keyframe_id: int) -> Submap:
        """The cloud of a keyframe; if it is sparse, merged with its neighbours' clouds in its frame."""
        made = self.gathered(keyframe_id)
        if made.points is made.seen_from_here or keyframe_id not in self._by_shape:
            return made
        return replace(made, labels=self._labeller(made.points))  # geometric labels are better on a denser cloud

    def gathered(self, keyframe_id: int, *, newest_id: int | None = None) -> Submap:
        """The submap with the labels stored in the keyframes, without keyframes after `newest_id`."""
        points, labels = self._clouds().cloud(keyframe_id)
        clouds, all_labels = [points], [labels]
        for neighbour in self._neighbours(keyframe_id, len(self.T_odom) - 1 if newest_id is None else newest_id):
            if self._is_dense(clouds):
                break
            T_keyframe_neighbour = geometry.inverse(self.T_odom[keyframe_id]) @ self.T_odom[neighbour]
            more, more_labels = self._clouds().cloud(neighbour)
            clouds.append(geometry.apply(T_keyframe_neighbour, more.astype(np.float64)).astype(np.float32))
            all_labels.append(more_labels)
        if len(clouds) == 1:
            return Submap(points, labels, points)
        return Submap(np.vstack(clouds), np.concatenate(all_labels), points)

    def prepared(self, keyframe_id: int) -> PreparedScan:
        """The submap of a keyframe, prepared for alignment."""
        made = self.submap(keyframe_id)
        return prepare_scan(made.points, made.labels, config=self._config, seen_from_here=made.seen_from_here)

    def lag(self, keyframe_id: int) -> int:
        """Number of keyframes back to the nearest one whose submap shares no scan with this one's."""
        return 1 if self._is_dense([self._clouds().cloud(keyframe_id)[0]]) else MAX_GATHERED + 1

    def _is_dense(self, clouds: list[Points]) -> bool:
        downsampled = refinement.downsample(np.vstack(clouds), config=self._config.refine)
        return len(downsampled) >= DENSE_VOXELS

    def _neighbours(self, keyframe_id: int, newest_id: int) -> Iterator[int]:
        """Keyframes around one, nearest first, that odometry connects to it without a break."""
        travel_m = self._travel_m()
        for step in range(1, MAX_GATHERED // 2 + 1):
            for neighbour in (keyframe_id - step, keyframe_id + step):
                if 0 <= neighbour <= newest_id and abs(travel_m[neighbour] - travel_m[keyframe_id]) < BREAK_TRAVEL_M:
                    yield neighbour
