"""Poses of a scan in a local map, found in three ways: from initial guesses, around the last pose, without a guess."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from segslam import geometry
from segslam.health.history import History
from segslam.health.local_map import Fit, LocalMap
from segslam.refinement import LightSurface, Surface
from segslam.types import Alignment, Points, Rejected, Transform

Recover = Callable[[Points, Points], Alignment | Rejected]
"""Registers a source (n, 3) with a target (m, 3) without initial guess, and verifies the result."""
DIFFERENT_M, DIFFERENT_RAD = 0.3, np.radians(3.0)
"""Chosen: initial guesses nearer to each other than this lead to the same pose."""
SUPPORT_M, SUPPORT_RAD = 0.5, np.radians(3.0)
"""Chosen: a registration this near to a pose from another source is supported by it, and a lower overlap suffices."""
NEARLY = 0.97
"""Chosen: share of the best closeness with which a registration fits nearly as well."""
TURN_M = 5.0
"""Chosen: distance equivalent to a rotation by one radian (m)."""


@dataclass(frozen=True, slots=True)
class FoundPose:
    """Pose of a scan in a local map, and the quality of its fit."""

    T_map_lidar: Transform
    fit: Fit
    T_odom_lidar: Transform

    def offset_m(self, T_odom_expected: Sequence[Transform]) -> float:
        """Distance from the nearest of some poses (m); a rotation counts `TURN_M` per radian."""
        offsets = [geometry.inverse(T_odom_other) @ self.T_odom_lidar for T_odom_other in T_odom_expected]
        return min(geometry.distance(T) + TURN_M * geometry.angle(T) for T in offsets)

    def is_near(self, T_odom_supporting: Sequence[Transform]) -> bool:
        """True if it is near to one of some poses."""
        offsets = [geometry.inverse(T_odom_other) @ self.T_odom_lidar for T_odom_other in T_odom_supporting]
        return any(geometry.distance(T) < SUPPORT_M and geometry.angle(T) < SUPPORT_RAD for T in offsets)


class SeenScan:
    """A scan: all its points, its downsampled points, and their surfaces, each computed on first use."""

    def __init__(self, points: Points, local: LocalMap) -> None:
        """`points` (n, 3) in the scan's frame; they are downsampled as those of the map `local`."""
        self._local = local
        self.points = points

    @cached_property
    def thinned(self) -> Points:
        """(m, 3) the downsampled points."""
        return self._local.downsample(self.points)

    @cached_property
    def light(self) -> LightSurface:
        """The surface for the quick check."""
        return LightSurface(self.thinned)

    @cached_property
    def surface(self) -> Surface:
        """The surface for a registration."""
        return self._local.make_surface(self.thinned)


class PoseSearch:
    """Registers scans with a local map and chooses the best result, or none."""

    def __init__(self, history: History, recover: Recover, *, dense_voxels: int) -> None:
        """`recover` receives the newest scans of a map, as many as have `dense_voxels` voxels."""
        self._history = history
        self._recover = recover
        self._dense_voxels = dense_voxels

    def near(
        self,
        local: LocalMap,
        scan: SeenScan,
        T_odom_guesses: Sequence[Transform],
        *,
        around: tuple[Transform, Transform] | None = None,
        T_odom_supporting: Sequence[Transform] = (),
    ) -> FoundPose | None:
        """The best registration from the guesses, the first two of which are expected poses; None if none is good.

        `around`: the last pose and the predicted one. If no guess leads to the usual fit, poses around the last one are
        compared, and the best is registered too. `T_odom_supporting`: poses known from other sources than this scan;
        near to one of them a lower overlap suffices.
        """
        guesses, expected = _different(T_odom_guesses), T_odom_guesses[:2]
        found = _registrations(local, scan, guesses)
        best = self._best(found, expected, T_odom_supporting)
        if around is None or (best is not None and self._history.is_usual(best.fit)):
            return best
        T_odom_last, T_odom_predicted = around
        T_map_last = geometry.inverse(local.T_odom_map) @ T_odom_last
        T_step = geometry.inverse(T_odom_last) @ T_odom_predicted
        T_odom_around = local.T_odom_map @ local.around(scan.surface, T_map_last, T_step)
        more = _different([*guesses, T_odom_around])[len(guesses) :]
        return self._best(found + _registrations(local, scan, more), expected, T_odom_supporting)

    def without_guess(self, local: LocalMap, scan: SeenScan, *, must_be_usual: bool = False) -> FoundPose | None:
        """The pose without initial guess, verified like a loop and then registered; None if there is none.

        If the registration ends near the verified pose, a lower overlap suffices, unless it `must_be_usual`.
        """
        alignment = self._recover(scan.points, local.cloud(self._dense_voxels))
        if isinstance(alignment, Rejected):
            return None
        verified = [local.T_odom_map @ alignment.fine.T_target_source]
        return self._best(_registrations(local, scan, verified), verified, () if must_be_usual else verified)

    def _best(
        self, found: list[FoundPose], T_odom_expected: Sequence[Transform], T_odom_supporting: Sequence[Transform]
    ) -> FoundPose | None:
        """The registration that fits best; None if it does not fit as usual and is not supported.

        Of those that fit nearly as well, as all poses along a wall do, it is the one nearest to an expected pose.
        """
        if not found:
            return None
        enough = NEARLY * max(each.fit.closeness for each in found)
        good = [each for each in found if each.fit.closeness >= enough]
        best = min(good, key=lambda each: each.offset_m(T_odom_expected))
        is_supported = best.is_near(T_odom_supporting) and self._history.is_plausible(best.fit)
        return best if self._history.is_usual(best.fit) or is_supported else None


def _registrations(local: LocalMap, scan: SeenScan, T_odom_guesses: Sequence[Transform]) -> list[FoundPose]:
    """All registrations from some initial guesses."""
    return [
        FoundPose(T_map_lidar, local.fit(scan.surface, T_map_lidar), local.T_odom_map @ T_map_lidar)
        for T_odom_guess in T_odom_guesses
        for T_map_lidar in local.register(scan.surface, geometry.inverse(local.T_odom_map) @ T_odom_guess)
    ]


def are_different(T_a_b: Transform) -> bool:
    """Whether two poses are so far from each other that a registration may lead to different results."""
    return geometry.distance(T_a_b) > DIFFERENT_M or bool(geometry.angle(T_a_b) > DIFFERENT_RAD)


def _different(guesses: Sequence[Transform]) -> list[Transform]:
    """The guesses without those near an earlier one."""
    kept: list[Transform] = []
    for guess in guesses:
        if all(are_different(geometry.inverse(other) @ guess) for other in kept):
            kept.append(guess)
    return kept
