"""Selection of keyframes, their points, and their clouds for matching, in which sparse ones are merged."""

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from segslam.candidates import PlaceSignature, signature_of
from segslam.core import geometry
from segslam.core.config import Config, KeyframeConfig
from segslam.core.points import voxel_first
from segslam.core.types import CloudOf, Indices, Keyframe, Label, Labels, Points, Transform, Vector
from segslam.registration import refinement
from segslam.registration.prepared import Labeller, Observed, PreparedScan, prepare_observed, prepare_scan

DENSE_VOXELS = 3000
"""Chosen on KITTI, courtyard, NCLT: a keyframe with fewer voxels (refine.voxel_m) is matched together with its
neighbours' points."""
MAX_GATHERED = 10
"""Chosen: largest number of neighbouring keyframes whose points are merged."""
ANGLE_DEG = 20.0
"""Chosen: rotation after which a keyframe is made before `keyframes.distance_m` is reached (degrees)."""


class KeyframeSelector:
    """Selects a scan as keyframe if distance or rotation from the last keyframe are large enough."""

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._T_odom_last: Transform | None = None
        self._T_odom_keyframe: Transform | None = None
        self.travel_m = 0.0
        """Length of the path through all scans so far."""

    def update(self, T_odom_lidar: Transform, *, after_break: bool = False) -> bool:
        """True if the next scan becomes a keyframe, as do the first scan and the first after a break.

        The distance is the straight one from the last keyframe, so that jitter of a standing sensor adds no keyframes.
        """
        if self._T_odom_last is not None:
            self.travel_m += geometry.distance(geometry.inverse(self._T_odom_last) @ T_odom_lidar)
        self._T_odom_last = T_odom_lidar
        if self._T_odom_keyframe is not None and not after_break:
            moved = geometry.inverse(self._T_odom_keyframe) @ T_odom_lidar
            if geometry.distance(moved) < self._config.distance_m and geometry.angle(moved) < math.radians(ANGLE_DEG):
                return False
        self._T_odom_keyframe = T_odom_lidar
        return True


def downsample_keyframe(
    points: Points, labels: Labels, *, config: KeyframeConfig, whole_classes: Collection[Label]
) -> tuple[Points, Labels, Indices]:
    """The points of a keyframe: all points of `whole_classes`, one per voxel of the others; float32, rounded.

    Also returns their labels and rows. All later stages use these points, and the log contains exactly these, so that a
    replay repeats the run.
    """
    is_kept = np.isin(labels, np.array([int(label) for label in whole_classes], dtype=np.uint8))
    others = np.flatnonzero(~is_kept)
    is_kept[others[voxel_first(points.take(others, axis=0), config.voxel_m)]] = True
    kept = np.flatnonzero(is_kept)
    rounded = np.round(points.take(kept, axis=0).astype(np.float64) / config.resolution_m) * config.resolution_m
    return rounded.astype(np.float32), labels[kept], kept


@runtime_checkable
class Clouds(Protocol):
    """Storage of the points of keyframes."""

    def keep(self, keyframe: Keyframe) -> None:
        """Store the points of the newest keyframe."""
        ...

    def cloud(self, keyframe_id: int) -> tuple[Points, Labels]:
        """Points and labels of a keyframe, as stored."""
        ...


class CloudStore:
    """Stores points and labels in 7 bytes per point: coordinates are multiples of the keyframes' resolution."""

    def __init__(self, resolution_m: float) -> None:
        self._resolution_m = resolution_m
        self._kept: dict[int, tuple[np.ndarray, Labels]] = {}

    def keep(self, keyframe: Keyframe) -> None:
        """Store the points of the newest keyframe."""
        steps = np.rint(keyframe.points.astype(np.float64) / self._resolution_m)
        fits = np.abs(steps).max(initial=0.0) <= np.iinfo(np.int16).max
        self._kept[keyframe.id] = (steps.astype(np.int16 if fits else np.int32), keyframe.labels)

    def cloud(self, keyframe_id: int) -> tuple[Points, Labels]:
        """Points and labels of a keyframe, as stored."""
        steps, labels = self._kept[keyframe_id]
        return (steps * self._resolution_m).astype(np.float32), labels


@dataclass(frozen=True, slots=True, eq=False)
class Submap:
    """Points and labels in the frame of a keyframe; `seen_from_here`: the keyframe's own points."""

    points: Points
    labels: Labels
    seen_from_here: Points


def is_known(motion_variance: Vector, a: int, b: int, *, within_m: float) -> bool:
    """True if the motions between two keyframes together err by less than `within_m`.

    `motion_variance` (n,): largest variance of the motion that leads to each keyframe (m^2).
    """
    return bool(sum(motion_variance[min(a, b) + 1 : max(a, b) + 1]) < within_m**2)


class Submaps:
    """Submaps of the keyframes of a drive, computed on use."""

    def __init__(
        self, config: Config, clouds: CloudOf, labeller: Labeller, motion_variance: Callable[[], Vector]
    ) -> None:
        """`clouds` provides the points of keyframes by id, `labeller` geometric labels.

        `motion_variance`: as of `is_known`.
        """
        self._config, self._clouds, self._labeller = config, clouds, labeller
        self._motion_variance = motion_variance
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
        points, labels = self._clouds(keyframe_id)
        clouds, all_labels = [points], [labels]
        for neighbour in self._neighbours(keyframe_id, len(self.T_odom) - 1 if newest_id is None else newest_id):
            if len(refinement.downsample(np.vstack(clouds), config=self._config.refine)) >= DENSE_VOXELS:
                break
            T_keyframe_neighbour = geometry.inverse(self.T_odom[keyframe_id]) @ self.T_odom[neighbour]
            more, more_labels = self._clouds(neighbour)
            clouds.append(geometry.apply(T_keyframe_neighbour, more.astype(np.float64)).astype(np.float32))
            all_labels.append(more_labels)
        if len(clouds) == 1:
            return Submap(points, labels, points)
        return Submap(np.vstack(clouds), np.concatenate(all_labels), points)

    def signature(self, keyframe_id: int, recorded: bytes | None) -> PlaceSignature:
        """The signature of a keyframe's place: as recorded, or else of its submap without later keyframes."""
        if recorded is not None:
            return PlaceSignature.from_bytes(recorded)
        made = self.gathered(keyframe_id, newest_id=keyframe_id)
        return signature_of(made.points, made.labels)

    def prepared(self, keyframe_id: int) -> PreparedScan:
        """The submap of a keyframe, prepared for alignment."""
        made = self.submap(keyframe_id)
        return prepare_scan(made.points, made.labels, config=self._config, seen_from_here=made.seen_from_here)

    def observed(self, keyframe_id: int) -> Observed:
        """What the submap of a keyframe saw: sufficient for a pose that is nearly known."""
        made = self.submap(keyframe_id)
        return prepare_observed(made.points, made.labels, config=self._config, seen_from_here=made.seen_from_here)

    def _neighbours(self, keyframe_id: int, newest_id: int) -> Iterator[int]:
        """Keyframes around one, nearest first, whose relative pose odometry knows better than the size of a voxel."""
        variance = self._motion_variance()
        for step in range(1, MAX_GATHERED // 2 + 1):
            for first, last in ((keyframe_id - step, keyframe_id), (keyframe_id, keyframe_id + step)):
                is_there = first >= 0 and last <= newest_id
                if is_there and is_known(variance, first, last, within_m=self._config.refine.voxel_m):
                    yield first + last - keyframe_id
