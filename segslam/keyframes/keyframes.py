"""Selection of keyframes, and the points that a keyframe keeps."""

import math
from collections.abc import Collection
from typing import Protocol, runtime_checkable

import numpy as np

from segslam.core import geometry
from segslam.core.config import KeyframeConfig
from segslam.core.points import voxel_first
from segslam.core.types import Indices, Keyframe, Label, Labels, Points, Transform

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

    def update(self, T_odom_lidar: Transform, *, break_m: float = 0.0) -> bool:
        """True if the next scan becomes a keyframe, as do the first scan and the first after a break (`break_m`).

        The distance is the straight one from the last keyframe, so that jitter of a standing sensor adds no keyframes.
        """
        if break_m:
            self.travel_m += break_m
        elif self._T_odom_last is not None:
            self.travel_m += geometry.distance(geometry.inverse(self._T_odom_last) @ T_odom_lidar)
        self._T_odom_last = T_odom_lidar
        is_keyframe = break_m > 0 or self._T_odom_keyframe is None
        if self._T_odom_keyframe is not None:
            moved = geometry.inverse(self._T_odom_keyframe) @ T_odom_lidar
            is_keyframe |= geometry.distance(moved) >= self._config.distance_m
            is_keyframe |= geometry.angle(moved) >= math.radians(ANGLE_DEG)
        if is_keyframe:
            self._T_odom_keyframe = T_odom_lidar
        return is_keyframe


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
