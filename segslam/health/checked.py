"""An odometry whose motions are checked against the scans: confirmed, repaired, or marked as unknown.

As long as the odometry is sound, one scan every `keyframes.distance_m` is compared with the previous one by
`check.nudge`, in a few milliseconds. If the scans contradict a motion, the scan is registered with the last scans
(`LocalMap`): first from several initial guesses, then without any. Each following scan is registered as well, until the
odometry agrees with `watch_scans` registrations in a row. A motion that no registration supports is a break: a guess
with nearly no information.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from segslam import geometry
from segslam.config import Config
from segslam.health.check import nudge, open_direction
from segslam.health.history import LONG_GAP, LOST_SCANS, History, Intervals
from segslam.health.local_map import Fit, LocalMap
from segslam.health.restored import rows_in_maps
from segslam.odometry import Odometry, OdometryResult, deskew_scan
from segslam.refinement import Surface
from segslam.trajectory import Poses
from segslam.types import (
    Alignment,
    Direction,
    Indices,
    Information,
    Motion,
    MotionState,
    Points,
    Registration,
    Rejected,
    Scan,
    Transform,
)

Recover = Callable[[Points, Points], Alignment | Rejected]
"""Registers a source (n, 3) with a target (m, 3) without initial guess, and verifies the result."""
RECOVER_EVERY = 5
"""Chosen: number of scans tried after a break; every fifth is registered without initial guess, 0.2 s each."""
DIFFERENT_M, DIFFERENT_RAD = 0.3, np.radians(3.0)
"""Chosen: initial guesses nearer to each other than this lead to the same pose."""
LEAST_SUPPORTED = 0.15
SUPPORT_M, SUPPORT_RAD = 0.5, np.radians(3.0)
"""Chosen: a lower overlap suffices for a registration this near to an initial guess: two sources agree."""
BREAK_SIGMA_M, BREAK_SIGMA_RAD = 30.0, np.radians(60.0)
"""Standard deviations of an unsupported motion: the sensor may have been carried to any place nearby."""
SUDDEN_M, SUDDEN_RAD = 0.5, np.radians(5.0)
"""Chosen: a motion that differs by more than this from the previous one is checked, however short it is."""
CHECK_EVERY = 10
"""Chosen: at least every tenth scan is checked, because a stuck odometry reports no motion."""
UNSEEN_SHARE = 0.7
"""Chosen: standard deviation of a predicted motion in a direction that the scans do not constrain, as a share of it."""
SEEN_M, SEEN_RAD = 0.05, np.radians(0.2)
"""Chosen: standard deviations of such a motion in the other directions."""


@dataclass(frozen=True, slots=True)
class _Found:
    """Pose of a scan in a local map, and the quality of its fit."""

    T_map_lidar: Transform
    fit: Fit
    registration: Registration


class CheckedOdometry:
    """Another odometry with its motions checked and repaired; itself an `Odometry`."""

    def __init__(self, inner: Odometry, config: Config, *, recover: Recover) -> None:
        """`recover` registers two clouds without initial guess."""
        self._inner = inner
        self._config = config.health
        self._keyframes = config.keyframes
        self._odometry = config.odometry
        self._min_points = config.refine.min_points
        self._recover = recover
        self._map = LocalMap(config.health, config.refine)
        self._lost: LocalMap | None = None
        """The map before a break, as long as scans are tried against it."""
        self._history = History(config.health)
        self._anchor: tuple[Transform, Surface] | None = None
        """Pose and surface of the last checked scan."""
        self._T_odom_last = np.eye(4)
        self._T_before_last = self._T_steady = np.eye(4)
        """Motion between the last two scans, per interval of the sensor; and the last one confirmed by the scans."""
        self._intervals = 1.0
        """Intervals from the last scan to this one, if scans between them are known to be lost."""
        self._pace = Intervals()
        self._num_unchecked = 0
        """Number of scans since the last checked one."""

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        """The checked pose and the cropped points of the next scan. `gap` and BadScan as for the inner odometry."""
        self._intervals = gap
        proposed = self._inner.register(scan, gap=gap)
        if not self._config.check:
            return proposed
        T_odom_lidar, motion = self._checked(proposed, self._pace.note(scan.stamp_ns))
        self._T_before_last = self._since_last(T_odom_lidar)
        self._T_odom_last = T_odom_lidar
        return OdometryResult(T_odom_lidar, proposed.points, proposed.labels, proposed.intensities, motion)

    def restore(
        self, T_odom_lidar: Poses, motions: Sequence[Motion], stamps_ns: Indices, scan_of: Callable[[int], Scan]
    ) -> None:
        """Continue after scans with these poses, motions and stamps; `scan_of` reads the scan of a row.

        The state equals that of an uninterrupted run: exactly if no motion was registered again, otherwise up to
        rounding.
        """
        if not self._config.check:
            self._inner.restore(T_odom_lidar, scan_of)
            return
        for stamp_ns in stamps_ns:
            self._pace.note(int(stamp_ns))
        rows = rows_in_maps(
            T_odom_lidar, motions, history=self._history, empty=self._map.empty_copy, map_scans=self._config.map_scans
        )

        def fill(rows: list[int]) -> LocalMap:
            local = self._map.empty_copy()
            for row in rows:
                points = self._points(T_odom_lidar, row, scan_of)
                local.add(T_odom_lidar[row], local.downsample(points), points)
            return local

        since = None if rows.followed is None else (rows.followed[0], fill(rows.followed[1]).scans)
        self._inner.restore(T_odom_lidar, scan_of, since=since)
        self._map, self._lost = fill(rows.now), None if rows.lost is None else fill(rows.lost)
        checked = max(row for row, motion in enumerate(motions) if row == 0 or motion.state != MotionState.UNCHECKED)
        self._num_unchecked = len(motions) - 1 - checked
        surface = self._map.make_surface(self._map.downsample(self._points(T_odom_lidar, checked, scan_of)))
        self._anchor = T_odom_lidar[checked], surface
        self._T_odom_last = T_odom_lidar[-1]
        if len(T_odom_lidar) > 1:
            self._T_before_last = self._T_steady = geometry.inverse(T_odom_lidar[-2]) @ T_odom_lidar[-1]

    def _points(self, T_odom_lidar: Poses, row: int, scan_of: Callable[[int], Scan]) -> Points:
        """The cropped points of an earlier scan, motion-compensated as before."""
        T_last_lidar = np.eye(4) if row < 2 else np.linalg.inv(T_odom_lidar[row - 2]) @ T_odom_lidar[row - 1]
        return deskew_scan(scan_of(row), T_last_lidar, self._odometry)[0].astype(np.float32)

    def _since_last(self, T_odom_lidar: Transform) -> Transform:
        """The motion per interval of the sensor."""
        return geometry.scaled(geometry.inverse(self._T_odom_last) @ T_odom_lidar, 1 / self._intervals)

    def _checked(self, proposed: OdometryResult, gap: float) -> tuple[Transform, Motion]:
        if self._anchor is None:
            self._take(proposed.T_odom_lidar, self._map.downsample(proposed.points), proposed.points, None)
            return proposed.T_odom_lidar, Motion(MotionState.UNCHECKED)
        T_predicted_lidar = geometry.inverse(self._T_odom_last @ self._T_before_last) @ proposed.T_odom_lidar
        self._num_unchecked += 1
        is_suspect = (
            self._num_unchecked >= CHECK_EVERY
            or gap > LONG_GAP
            or _is_sudden(T_predicted_lidar)
            or self._history.is_watching
        )
        T_anchor_lidar = geometry.inverse(self._anchor[0]) @ proposed.T_odom_lidar
        is_far = geometry.distance(T_anchor_lidar) >= self._keyframes.distance_m
        if not (is_suspect or is_far or geometry.angle(T_anchor_lidar) >= np.radians(self._keyframes.angle_deg)):
            return proposed.T_odom_lidar, Motion(MotionState.UNCHECKED)
        self._num_unchecked = 0
        thinned = self._map.downsample(proposed.points)
        if min(len(thinned), len(self._anchor[1])) < self._min_points:  # too sparse for a check
            return proposed.T_odom_lidar, Motion(MotionState.UNCHECKED)
        surface = self._map.make_surface(thinned)
        direction = open_direction(surface)
        if direction is not None:
            self._history.watch()
        if not self._history.is_watching:
            found = nudge(thinned, self._anchor[1], T_anchor_lidar)
            self._history.note_check(found)
            if found is not None and not self._history.is_watching:
                self._take(proposed.T_odom_lidar, thinned, proposed.points, surface)
                self._T_steady = self._since_last(proposed.T_odom_lidar)
                moved_deg = float(np.degrees(found.moved_rad))
                return proposed.T_odom_lidar, Motion(MotionState.CONFIRMED, found.moved_m, moved_deg, found.overlap)
        return self._registered(proposed, thinned, surface, direction, gap)

    def _registered(
        self, proposed: OdometryResult, thinned: Points, surface: Surface, direction: Direction | None, gap: float
    ) -> tuple[Transform, Motion]:
        """The scan's pose in the local map, or in the map before a break, or a guess.

        In a `direction` that the scan does not constrain, its position is predicted from the last confirmed motion.
        """
        T_odom_proposed = proposed.T_odom_lidar
        T_before_last = self._T_before_last if direction is None else self._T_steady
        T_odom_predicted = _exact(self._T_odom_last @ geometry.scaled(T_before_last, gap))
        guesses = [T_odom_proposed, T_odom_predicted, self._T_odom_last]
        before_break = self._lost
        found = self._found_again(surface, proposed.points, guesses) if direction is None else None
        if found is not None and before_break is not None:
            self._map, self._lost = before_break, None
        else:
            found = self._best(self._map, surface, guesses) or self._recovered(self._map, surface, proposed.points)
        if found is None and direction is not None:
            return self._break(T_odom_predicted, thinned, proposed.points, surface)
        if found is None:
            return self._unsupported(T_odom_proposed, T_odom_predicted, thinned, proposed.points, surface)
        T_odom_lidar = _exact(self._map.T_odom_map @ found.T_map_lidar)
        if direction is not None:
            T_odom_along = T_odom_predicted if self._inner.is_from_scans else T_odom_proposed
            T_odom_lidar = _moved_along(direction, T_odom_lidar, T_odom_along)
        off = geometry.inverse(T_odom_proposed) @ T_odom_lidar
        moved_m, moved_rad = geometry.distance(off), geometry.angle(off)
        state = self._history.note_registration(moved_m, moved_rad, found.fit)
        if before_break is not None and self._map is before_break:
            state = MotionState.REJOINED
        elif state is MotionState.REFINED and not self._inner.is_from_scans:
            state, T_odom_lidar = MotionState.CONFIRMED, T_odom_proposed  # the odometry uses more than these scans
        information = None
        if direction is None:
            self._T_steady = self._since_last(T_odom_lidar)
        elif state is not MotionState.CONFIRMED:
            state, information = MotionState.BROKEN, _open_information(direction, self._T_steady)
        self._take(T_odom_lidar, thinned, proposed.points, surface)
        if state is not MotionState.CONFIRMED:
            T_before_lidar = _exact(self._since_last(T_odom_lidar))
            self._inner.follow(self._map.scans, T_odom_lidar, T_before_lidar)
        fit = found.fit
        moved_deg = float(np.degrees(moved_rad))
        return T_odom_lidar, Motion(state, moved_m, moved_deg, fit.overlap, fit.rms_m, information=information)

    def _unsupported(
        self,
        T_odom_proposed: Transform,
        T_odom_predicted: Transform,
        thinned: Points,
        points: Points,
        surface: Surface,
    ) -> tuple[Transform, Motion]:
        """A motion that no registration supports: that of the odometry, if steady and with some overlap; else a break.

        Sparse scans cannot always be registered; this alone is no evidence against the odometry.
        """
        found = self._map.fit(surface, geometry.inverse(self._map.T_odom_map) @ T_odom_proposed)
        off = geometry.inverse(T_odom_predicted) @ T_odom_proposed
        if found.overlap >= LEAST_SUPPORTED and not _is_sudden(off):
            return T_odom_proposed, Motion(MotionState.UNCHECKED)
        return self._break(T_odom_predicted, thinned, points, surface)

    def _best(self, local: LocalMap, surface: Surface, T_odom_guesses: list[Transform]) -> _Found | None:
        """The registration with the largest overlap, from distinct guesses; None if none has the usual fit."""
        T_map_odom = geometry.inverse(local.T_odom_map)
        best: _Found | None = None
        for T_map_guess in _different([T_map_odom @ T_odom_guess for T_odom_guess in T_odom_guesses]):
            registration = local.register(surface, T_map_guess)
            if isinstance(registration, Registration):
                found = _Found(
                    registration.T_target_source, local.fit(surface, registration.T_target_source), registration
                )
                if best is None or found.fit.overlap > best.fit.overlap:
                    best = found
        if best is None or not (
            self._history.is_usual(best.fit) or _is_supported(best, T_map_odom, T_odom_guesses[:2])
        ):
            return None
        return best

    def _recovered(self, local: LocalMap, surface: Surface, points: Points) -> _Found | None:
        """The pose without initial guess, verified like a loop and then registered; None if there is none."""
        alignment = self._recover(points, local.cloud(self._keyframes.dense_voxels))
        if isinstance(alignment, Rejected):
            return None
        return self._best(local, surface, [local.T_odom_map @ alignment.fine.T_target_source])

    def _found_again(self, surface: Surface, points: Points, T_odom_guesses: list[Transform]) -> _Found | None:
        """The pose in the map before the last break, if the break was within the last `LOST_SCANS`."""
        if self._lost is None:
            return None
        self._history.scans_lost += 1
        if found := self._best(self._lost, surface, T_odom_guesses):
            return found
        if self._history.scans_lost % RECOVER_EVERY == 0 and (found := self._recovered(self._lost, surface, points)):
            return found
        if self._history.scans_lost >= LOST_SCANS:
            self._lost = None
        return None

    def _break(
        self, T_odom_lidar: Transform, thinned: Points, points: Points, surface: Surface
    ) -> tuple[Transform, Motion]:
        """Start a new local map at a guess; the old one is kept for some time."""
        if self._lost is None:
            self._lost, self._map = self._map, self._map.empty_copy()
            self._history.scans_lost = 0
        else:
            self._map.clear()
        self._history.watch()
        self._take(T_odom_lidar, thinned, points, surface)
        self._inner.follow(self._map.scans, T_odom_lidar, np.eye(4))
        sigmas = geometry.tangent(rotation_rad=BREAK_SIGMA_RAD, translation_m=BREAK_SIGMA_M)
        return T_odom_lidar, Motion(MotionState.BROKEN, information=np.diag(sigmas**-2.0))

    def _take(self, T_odom_lidar: Transform, thinned: Points, points: Points, surface: Surface | None) -> None:
        """Make the scan the reference of the next check, and add it to the local map."""
        self._anchor = T_odom_lidar, surface or self._map.make_surface(thinned)
        self._map.add(T_odom_lidar, thinned, points)


def _moved_along(direction: Direction, T_odom_lidar: Transform, T_odom_along: Transform) -> Transform:
    """A pose, with its position along a direction in its own frame replaced by that of another pose."""
    apart = (geometry.inverse(T_odom_lidar) @ T_odom_along)[:3, 3]
    return T_odom_lidar @ geometry.transform(np.eye(3), direction * (direction @ apart))


def _open_information(direction: Direction, T_predicted: Transform) -> Information:
    """Information of a motion predicted along a direction that the new scan does not constrain."""
    sigma_m = max(UNSEEN_SHARE * geometry.distance(T_predicted), 0.1)
    covariance = np.diag(geometry.tangent(rotation_rad=SEEN_RAD, translation_m=SEEN_M) ** 2)
    covariance[3:, 3:] += sigma_m**2 * np.outer(direction, direction)
    return np.linalg.inv(covariance)


def _exact(T_a_b: Transform) -> Transform:
    """The pose without the rounding errors that long products accumulate in a rotation: KISS-ICP rejects 1e-11."""
    return geometry.transform(geometry.nearest_rotation(T_a_b[:3, :3]), T_a_b[:3, 3])


def _is_supported(found: _Found, T_map_odom: Transform, T_odom_guesses: list[Transform]) -> bool:
    """True if a guess, which does not depend on the registration, is near a registered pose with some overlap."""
    if found.fit.overlap < LEAST_SUPPORTED:
        return False
    offsets = [geometry.inverse(T_map_odom @ T_odom_guess) @ found.T_map_lidar for T_odom_guess in T_odom_guesses]
    return any(geometry.distance(o) < SUPPORT_M and geometry.angle(o) < SUPPORT_RAD for o in offsets)


def _is_sudden(T_predicted_lidar: Transform) -> bool:
    """True if the motion differs much from the previous one."""
    return geometry.distance(T_predicted_lidar) > SUDDEN_M or bool(geometry.angle(T_predicted_lidar) > SUDDEN_RAD)


def _different(guesses: list[Transform]) -> list[Transform]:
    """The guesses without those near an earlier one."""
    kept: list[Transform] = []
    for guess in guesses:
        offsets = [geometry.inverse(other) @ guess for other in kept]
        if all(geometry.distance(o) > DIFFERENT_M or geometry.angle(o) > DIFFERENT_RAD for o in offsets):
            kept.append(guess)
    return kept


def least_informed(motions: Sequence[Motion]) -> Information | None:
    """The information of the least certain motion; None if the noise model of odometry applies to all."""
    own = [motion.information for motion in motions if motion.information is not None]
    return min(own, key=lambda information: float(np.trace(information))) if own else None
