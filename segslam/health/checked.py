"""An odometry whose motions are checked against the scans: confirmed, repaired, or marked as unknown.

As long as the odometry is sound, one scan every `keyframes.distance_m` is compared with the previous one by
`check.nudge`, in a few milliseconds. If the scans contradict a motion, the scan is registered with the last scans
(`LocalMap`): first from several initial guesses, then from the best of many poses around the last one, then without
any. Each following scan is registered as well, until the odometry agrees with `watch_scans` registrations in a row,
after the n-th repair with n times as many. A motion that no registration supports is a break: a guess with nearly no
information.
"""

from collections.abc import Callable, Sequence

import numpy as np

from segslam import geometry
from segslam.config import Config
from segslam.health.check import nudge, open_direction
from segslam.health.history import LONG_GAP, History, Intervals
from segslam.health.local_map import LocalMap
from segslam.health.maps import MapsAroundBreak
from segslam.health.restored import rows_in_maps
from segslam.health.search import FoundPose, PoseSearch, Recover, SeenScan, are_different
from segslam.health.unconstrained import Unconstrained, is_predicted, moved_along, unknown_information
from segslam.odometry import Odometry, OdometryResult, deskew_scan
from segslam.refinement import LightSurface
from segslam.trajectory import Poses
from segslam.types import (
    Direction,
    Indices,
    Motion,
    MotionState,
    Points,
    Scan,
    Transform,
)

SUDDEN_M, SUDDEN_RAD = 0.5, np.radians(5.0)
"""Chosen: a motion that differs by more than this from the previous one is checked, however short it is, and so is a
rotation by more than this: on the real courtyard, scans 0.5 s apart, KISS-ICP misses turns."""
TURN_S = 2.0
"""Chosen: where scans are missing, another initial guess assumes that a turn ends after this time; so does a break."""
CHECK_EVERY = 10
"""Chosen: at least every tenth scan is checked, because a stuck odometry reports no motion."""


class CheckedOdometry:
    """Another odometry with its motions checked and repaired; itself an `Odometry`."""

    def __init__(self, inner: Odometry, config: Config, *, recover: Recover) -> None:
        """`recover` registers two clouds without initial guess."""
        self._inner = inner
        self._config = config.health
        self._keyframes = config.keyframes
        self._odometry = config.odometry
        self._min_points = config.refine.min_points
        self._history = History(config.health)
        self._search = PoseSearch(self._history, recover, dense_voxels=config.keyframes.dense_voxels)
        self._maps = MapsAroundBreak(LocalMap(config.health, config.refine), self._history, self._search)
        self._T_odom_last = np.eye(4)
        self._T_before_last = np.eye(4)
        """Motion between the last two scans, per interval of the sensor."""
        self._unconstrained = Unconstrained()
        self._intervals = 1.0
        """Intervals from the last scan to this one, more than 1 if scans between them are missing."""
        self._pace = Intervals()
        self._num_unchecked = 0
        """Number of scans since the last checked one."""
        self._has_motion = False
        """Whether any motion is known; the first has no prediction, and the odometry is easily wrong there."""

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        """The checked pose and the cropped points of the next scan. `gap` and BadScan as for the inner odometry."""
        proposed = self._inner.register(scan, gap=gap)
        if not self._config.check:
            return proposed
        self._intervals = max(gap, self._pace.note(scan.stamp_ns))
        T_odom_lidar, motion = self._checked(proposed)
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
            self._intervals = self._pace.note(int(stamp_ns))
        empty = self._maps.local.empty_copy
        rows = rows_in_maps(T_odom_lidar, motions, history=self._history, empty=empty, map_scans=self._config.map_scans)

        def fill(rows: list[int]) -> LocalMap:
            local = empty()
            for row in rows:
                points = self._points(T_odom_lidar, row, scan_of)
                local.add(T_odom_lidar[row], local.downsample(points), points)
            return local

        since = None if rows.followed is None else (rows.followed[0], fill(rows.followed[1]).scans)
        self._inner.restore(T_odom_lidar, scan_of, since=since)
        self._maps.local = fill(rows.now)
        self._maps.before_break = None if rows.lost is None else fill(rows.lost)
        checked = max(row for row, motion in enumerate(motions) if row == 0 or motion.state != MotionState.UNCHECKED)
        self._num_unchecked = len(motions) - 1 - checked
        self._maps.reference = T_odom_lidar[checked], self._light(T_odom_lidar, checked, scan_of)
        self._T_odom_last = T_odom_lidar[-1]
        self._has_motion = len(T_odom_lidar) > 1
        if self._has_motion:
            self._T_before_last = geometry.scaled(
                geometry.inverse(T_odom_lidar[-2]) @ T_odom_lidar[-1], 1 / self._intervals
            )
            self._restore_unconstrained(T_odom_lidar, motions, scan_of)

    def _restore_unconstrained(
        self, T_odom_lidar: Poses, motions: Sequence[Motion], scan_of: Callable[[int], Scan]
    ) -> None:
        """Restore the distance predicted since the last constrained motion, if the drive is in a tunnel."""
        seen = max((row for row, motion in enumerate(motions) if not is_predicted(motion)), default=0)
        T_motion = geometry.inverse(T_odom_lidar[max(seen - 1, 0)]) @ T_odom_lidar[seen]
        distance_m = float(np.linalg.norm(np.diff(T_odom_lidar[seen:, :3, 3], axis=0), axis=1).sum())
        last = len(motions) - 1
        direction = open_direction(self._light(T_odom_lidar, last, scan_of)) if seen < last else None
        self._unconstrained.restore(T_motion, distance_m if direction is not None else 0.0, direction)

    def _points(self, T_odom_lidar: Poses, row: int, scan_of: Callable[[int], Scan]) -> Points:
        """The cropped points of an earlier scan, motion-compensated as before."""
        T_last_lidar = np.eye(4) if row < 2 else np.linalg.inv(T_odom_lidar[row - 2]) @ T_odom_lidar[row - 1]
        return deskew_scan(scan_of(row), T_last_lidar, self._odometry)[0].astype(np.float32)

    def _light(self, T_odom_lidar: Poses, row: int, scan_of: Callable[[int], Scan]) -> LightSurface:
        """The surface of an earlier scan, for the quick check."""
        return LightSurface(self._maps.local.downsample(self._points(T_odom_lidar, row, scan_of)))

    def _since_last(self, T_odom_lidar: Transform) -> Transform:
        """The motion per interval of the sensor."""
        return geometry.scaled(geometry.inverse(self._T_odom_last) @ T_odom_lidar, 1 / self._intervals)

    def _checked(self, proposed: OdometryResult) -> tuple[Transform, Motion]:
        """The pose of a scan and the result of its check, if one is due."""
        scan = SeenScan(proposed.points, self._maps.local)
        if self._maps.reference is None:
            self._maps.add(proposed.T_odom_lidar, scan)
            return proposed.T_odom_lidar, Motion(MotionState.UNCHECKED)
        if not self._has_motion and self._inner.is_from_scans:
            T_odom_better = self._better_first(proposed.T_odom_lidar, scan)
            if T_odom_better is not None:
                self._has_motion = True
                self._history.watch()
                return self._registered(proposed.T_odom_lidar, scan, None, also=[T_odom_better])
        self._has_motion = True
        self._num_unchecked += 1
        T_odom_reference, reference = self._maps.reference
        T_reference_lidar = geometry.inverse(T_odom_reference) @ proposed.T_odom_lidar
        if not self._is_due(proposed.T_odom_lidar, T_reference_lidar):
            return proposed.T_odom_lidar, Motion(MotionState.UNCHECKED)
        self._num_unchecked = 0
        if min(len(scan.thinned), len(reference)) < self._min_points:  # too sparse for a check
            return proposed.T_odom_lidar, Motion(MotionState.UNCHECKED)
        direction = open_direction(scan.light)
        if direction is not None:
            self._history.watch()
        if not self._history.is_watching:
            found = nudge(scan.thinned, reference, T_reference_lidar)
            self._history.note_check(found)
            if found is not None and not self._history.is_watching:
                self._maps.add(proposed.T_odom_lidar, scan)
                self._unconstrained.note_observed(self._since_last(proposed.T_odom_lidar))
                moved_deg = float(np.degrees(found.moved_rad))
                return proposed.T_odom_lidar, Motion(MotionState.CONFIRMED, found.moved_m, moved_deg, found.overlap)
        return self._registered(proposed.T_odom_lidar, scan, direction)

    def _is_due(self, T_odom_proposed: Transform, T_reference_lidar: Transform) -> bool:
        """True if a motion is checked: it is suspect, or as long as a keyframe's since the last checked scan."""
        T_predicted_lidar = geometry.inverse(self._T_odom_last @ self._T_before_last) @ T_odom_proposed
        return bool(
            self._num_unchecked >= CHECK_EVERY
            or self._intervals > LONG_GAP
            or _is_sudden(T_predicted_lidar)
            or geometry.angle(self._since_last(T_odom_proposed)) > SUDDEN_RAD
            or self._history.is_watching
            or geometry.distance(T_reference_lidar) >= self._keyframes.distance_m
            or geometry.angle(T_reference_lidar) >= np.radians(self._keyframes.angle_deg)
        )

    def _better_first(self, T_odom_proposed: Transform, scan: SeenScan) -> Transform | None:
        """Another pose of the second scan, found with no guess, which fits the first better; None if there is none."""
        if len(scan.thinned) < self._min_points or len(self._maps.local) == 0:
            return None
        local = self._maps.local
        found = self._search.without_guess(local, scan)
        T_map_proposed = geometry.inverse(local.T_odom_map) @ T_odom_proposed
        if found is None or not are_different(geometry.inverse(T_map_proposed) @ found.T_map_lidar):
            return None
        is_better = found.fit.closeness > local.fit(scan.surface, T_map_proposed).closeness
        return local.T_odom_map @ found.T_map_lidar if is_better else None

    def _registered(
        self,
        T_odom_proposed: Transform,
        scan: SeenScan,
        direction: Direction | None,
        *,
        also: Sequence[Transform] = (),
    ) -> tuple[Transform, Motion]:
        """The scan's pose in the local map, or in the map before a break, or a guess.

        In a `direction` that the scan does not constrain, its position is predicted from the last confirmed motion.
        `also`: further initial guesses.
        """
        T_before_last = self._T_before_last if direction is None else self._unconstrained.T_steady
        T_odom_predicted = geometry.nearest_transform(
            self._T_odom_last @ geometry.scaled(T_before_last, self._intervals)
        )
        T_odom_ahead = geometry.nearest_transform(
            self._T_odom_last @ _straightened(T_before_last, self._intervals, self._pace.usual_s)
        )
        guesses = [T_odom_proposed, T_odom_predicted, self._T_odom_last, T_odom_ahead, *also]
        found = self._maps.rejoin(scan, guesses) if direction is None else None
        is_rejoined = found is not None
        if found is None:
            around = None if direction is not None else (self._T_odom_last, T_odom_predicted)
            supporting = [*self._supporting(T_odom_proposed, T_odom_predicted), *also]
            local = self._maps.local
            found = self._search.near(local, scan, guesses, around=around, T_odom_supporting=supporting)
            found = found or self._search.without_guess(local, scan)
        T_odom_along = T_odom_predicted if self._inner.is_from_scans else T_odom_proposed
        if found is not None:
            return self._accepted(found, T_odom_proposed, T_odom_along, scan, direction, is_rejoined=is_rejoined)
        if (direction is not None or self._unconstrained.direction is not None) and self._intervals <= LONG_GAP:
            return self._at_tunnel_end(T_odom_along, scan, direction)
        if direction is not None:
            return self._break(T_odom_ahead, scan)
        return self._unsupported(T_odom_proposed, T_odom_ahead, scan)

    def _accepted(
        self,
        found: FoundPose,
        T_odom_proposed: Transform,
        T_odom_along: Transform,
        scan: SeenScan,
        direction: Direction | None,
        *,
        is_rejoined: bool,
    ) -> tuple[Transform, Motion]:
        """The pose and the motion after a successful registration; the inner odometry continues from there.

        Along a `direction` that the scan does not constrain, the position is that of `T_odom_along`. `is_rejoined`:
        the scan was registered with the map before a break.
        """
        T_odom_lidar = geometry.nearest_transform(self._maps.local.T_odom_map @ found.T_map_lidar)
        if direction is not None:
            T_odom_lidar = moved_along(direction, T_odom_lidar, T_odom_along)
        off = geometry.inverse(T_odom_proposed) @ T_odom_lidar
        moved_m, moved_rad = geometry.distance(off), geometry.angle(off)
        state = self._history.note_registration(moved_m, moved_rad, found.fit)
        if is_rejoined:
            state = MotionState.REJOINED
        elif state is MotionState.REFINED and not self._inner.is_from_scans:
            state, T_odom_lidar = MotionState.CONFIRMED, T_odom_proposed  # the odometry uses more than these scans
        information = unknown_information() if is_rejoined else None  # the scans before are at a guess
        if direction is None:
            self._unconstrained.note_observed(self._since_last(T_odom_lidar))
        elif state is not MotionState.CONFIRMED:
            state = MotionState.BROKEN
            information = self._unconstrained.note_predicted(
                self._distance_m(T_odom_lidar), direction, is_registered=True
            )
        self._maps.add(T_odom_lidar, scan)
        if state is not MotionState.CONFIRMED:
            T_before_lidar = geometry.nearest_transform(self._since_last(T_odom_lidar))
            self._inner.follow(self._maps.local.scans, T_odom_lidar, T_before_lidar)
        fit, moved_deg = found.fit, float(np.degrees(moved_rad))
        return T_odom_lidar, Motion(state, moved_m, moved_deg, fit.overlap, fit.rms_m, information=information)

    def _supporting(self, T_odom_proposed: Transform, T_odom_predicted: Transform) -> list[Transform]:
        """Poses that support a registration: the prediction, unless scans are missing; an odometry of other sensors.

        A proposal made from the same scans, which may be wrong in the same way, supports it at the start only.
        """
        if self._intervals > LONG_GAP:
            return [] if self._inner.is_from_scans else [T_odom_proposed]
        is_known = self._inner.is_from_scans and self._history.is_usual_known
        return [T_odom_predicted] if is_known else [T_odom_predicted, T_odom_proposed]

    def _unsupported(
        self, T_odom_proposed: Transform, T_odom_predicted: Transform, scan: SeenScan
    ) -> tuple[Transform, Motion]:
        """A motion that no registration supports: that of the odometry, if steady and with some overlap; else a break.

        Sparse scans cannot always be registered; this alone is no evidence against the odometry.
        """
        local = self._maps.local
        found = local.fit(scan.surface, geometry.inverse(local.T_odom_map) @ T_odom_proposed)
        off = geometry.inverse(T_odom_predicted) @ T_odom_proposed
        is_steady = not _is_sudden(off) and (self._intervals <= LONG_GAP or not self._inner.is_from_scans)
        if is_steady and self._history.is_plausible(found):
            return T_odom_proposed, Motion(MotionState.UNCHECKED)
        return self._break(T_odom_predicted, scan)

    def _at_tunnel_end(
        self, T_odom_predicted: Transform, scan: SeenScan, direction: Direction | None
    ) -> tuple[Transform, Motion]:
        """The predicted pose where a tunnel begins or ends between two scans, which have nothing in common."""
        overlap = self._maps.local.fit(
            scan.surface, geometry.inverse(self._maps.local.T_odom_map) @ T_odom_predicted
        ).overlap
        information = self._unconstrained.note_predicted(
            self._distance_m(T_odom_predicted), direction, is_registered=False
        )
        self._restart(T_odom_predicted, scan, self._unconstrained.T_steady)
        return T_odom_predicted, Motion(MotionState.BROKEN, overlap=overlap, information=information)

    def _distance_m(self, T_odom_lidar: Transform) -> float:
        return geometry.distance(geometry.inverse(self._T_odom_last) @ T_odom_lidar)

    def _break(self, T_odom_lidar: Transform, scan: SeenScan) -> tuple[Transform, Motion]:
        """A guess that nothing supports."""
        self._restart(T_odom_lidar, scan, np.eye(4))
        self._unconstrained.note_observed(np.eye(4))
        return T_odom_lidar, Motion(MotionState.BROKEN, information=unknown_information())

    def _restart(self, T_odom_lidar: Transform, scan: SeenScan, T_before_lidar: Transform) -> None:
        """Start a new local map at a guess; the inner odometry continues from there with this motion per interval."""
        self._maps.restart(T_odom_lidar, scan)
        self._history.watch()
        self._inner.follow(self._maps.local.scans, T_odom_lidar, T_before_lidar)


def _straightened(T_step: Transform, gap: float, usual_s: float) -> Transform:
    """The motion over `gap` intervals of `usual_s` seconds, from that of one, if a turn ends after `TURN_S`."""
    turning = min(gap, max(TURN_S / usual_s, 1.0)) if usual_s > 0.0 else gap
    straight = geometry.transform(np.eye(3), (gap - turning) * T_step[:3, 3])
    return geometry.scaled(T_step, turning) @ straight


def _is_sudden(T_predicted_lidar: Transform) -> bool:
    """True if the motion differs much from the previous one."""
    return geometry.distance(T_predicted_lidar) > SUDDEN_M or bool(geometry.angle(T_predicted_lidar) > SUDDEN_RAD)
