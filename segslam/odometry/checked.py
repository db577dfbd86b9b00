"""An odometry whose motions are compared with the most likely ones, given the map of the last scans.

As long as the odometry is sound, a scan every `keyframes.distance_m` is compared with the previous one in a few
milliseconds. If this contradicts the motion, the scan is registered with the last scans from several proposals: the
odometry's motion and the last motion; and, if no pose near a proposal explains the scan as scans of this drive usually
are explained or has a good score, no motion and poses all around, and by place recognition. The most likely pose is
kept; where several explain the scan nearly as well, that is the one with the usual motion. At the start, after a
repair, and while its poses differ from the last registrations by more than these are unsure, every scan is registered.
After a repair the odometry continues from the local map; smaller corrections leave it undisturbed. They are added to
its following poses while every scan is registered; else they are taken as errors that it corrects itself. Points with
times are moved to the end of their sweep by the motion that the pose shows, and the scan is registered again. A scan
with too few points to show its motion moves on as the last ones did.
"""

import math
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace
from statistics import median
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.probabilities import INLIER_PROBABILITY, SIGNIFICANT
from segslam.core.types import Information, Motion, MotionState, Scan, Transform
from segslam.graph.edges import BREAK_M
from segslam.graph.noise import odometry_information
from segslam.odometry.likelihood import LEAST_SIGMA_VOXELS, Fit
from segslam.odometry.local_map import LocalMap, SeenScan
from segslam.odometry.motion_model import WINDOW, Intervals, MotionModel
from segslam.odometry.search import PoseSearch, Recover
from segslam.odometry.sweep import Foreseeing, Odometry, OdometryResult, at_stamp, swept_by
from segslam.odometry.sweep_motion import SweepMotion, at_middle
from segslam.registration.refinement import SHARED_NOISE

ELSEWHERE_M = 30.0
ANYWHERE = geometry.tangent(rotation_rad=np.radians(60.0), translation_m=ELSEWHERE_M)
"""Chosen: standard deviations of a motion that no pose explains: the sensor may have been carried anywhere nearby."""
MOST_OFF = float(chdtri(6, SIGNIFICANT))
"""Chi-square above which a pose of the odometry is significantly off the registered one."""
MOST_OFF_TOGETHER = float(chdtri(6 * WINDOW, SIGNIFICANT))
"""Sum of these chi-squares above which an odometry is less sure than the registrations of its last scans."""
MOST_UNCHECKED = 2
"""Chosen: number of scans after which a sensor that seems to stand still is checked: it may have begun to turn. Turns
of 15 degrees a scan are then within the reach of the search."""

NUM_SWEPT = 2
"""Chosen: a registration shows the motion during its sweep, by which the points are moved and registered again, twice:
if once, the most shaken sensors are lost; the more often, the more noise where scans show a motion badly."""


class Proposed(NamedTuple):
    """A scan, and its expected pose before it is compared with the last ones."""

    raw: Scan
    result: OdometryResult
    """Of the odometry, perhaps with the points moved by another motion during the sweep."""
    scan: SeenScan
    """The points of the result."""
    T_odom_lidar: Transform
    """By the odometry."""
    T_odom_predicted: Transform
    """By the last motions."""
    gap: float
    """Time since the previous scan, in intervals of the sensor."""

    def at(self, T_odom_lidar: Transform, motion: Motion) -> OdometryResult:
        """The result with this pose."""
        return replace(self.result, T_odom_lidar=T_odom_lidar, motion=motion)


class CheckedOdometry:
    """Another odometry with its motions checked and replaced by more likely ones."""

    def __init__(self, inner: Odometry, config: Config, *, recover: Recover) -> None:
        """`recover` registers two clouds without initial guess."""
        self._inner = inner
        self._config = config
        self._map = LocalMap(config.refine)
        self._recover = recover
        self._lost: tuple[LocalMap, Transform, float] | None = None
        """The map before a break, in which the next scans are tried, the motion per interval there, and the intervals
        since then."""
        self._intervals = Intervals()
        self._motion = MotionModel()
        self._last_checks: deque[float] = deque(maxlen=WINDOW)
        self._last_fits: deque[float] = deque(maxlen=WINDOW)
        """How well the last scans were explained, when they were checked, and when they were registered."""
        self._T_odom_last = np.eye(4)
        self._T_odom_inner: Transform = np.eye(4)
        """Pose of the frame in which the inner odometry continues, undisturbed by small corrections."""
        self._num_unchecked = 0
        self._sweeps = SweepMotion()
        self._offs: deque[float] = deque(maxlen=WINDOW)
        """Chi-squares of the odometry's poses, compared with registered ones, since the last repair."""

    def register(self, scan: Scan, *, gap: float = 1.0, ahead: Scan | None = None) -> OdometryResult:
        """The checked pose and the cropped points of the next scan. `gap` and BadScan as for the inner odometry.

        `ahead`: the scan to be registered after it, if it is known.
        """
        gap = max(gap, self._intervals.gap(scan.stamp_ns))
        scan = self._intervals.spanned(scan)
        result = self._inner.register(scan, gap=gap)
        self._intervals.note(scan.stamp_ns)
        if ahead is not None and ahead.stamp_ns > scan.stamp_ns and isinstance(self._inner, Foreseeing):
            self._inner.foresee(self._intervals.spanned(ahead), gap=self._intervals.gap(ahead.stamp_ns))
        if not self._config.health.check:
            return at_stamp(scan, result)
        is_watched = self._is_watched
        T_odom_predicted = self._T_odom_last @ self._motion.predicted(gap)
        seen = SeenScan(result.points, self._config.refine)
        proposed = Proposed(scan, result, seen, self._T_odom_inner @ result.T_odom_lidar, T_odom_predicted, gap)
        checked = self._checked(proposed)
        assert checked.motion
        T_odom_lidar, state = checked.T_odom_lidar, checked.motion.state
        if checked.T_sweep is not None:
            is_break = state is MotionState.BROKEN
            self._sweeps.note(at_middle(scan, T_odom_lidar, checked.T_sweep), gap, is_break=is_break)
        self._T_odom_last = T_odom_lidar
        if is_watched and state is MotionState.REFINED:
            self._T_odom_inner = geometry.nearest_transform(T_odom_lidar @ geometry.inverse(result.T_odom_lidar))
        return at_stamp(scan, checked)

    @property
    def _is_watched(self) -> bool:
        """True while every scan is registered: until the odometry agrees with a window of registrations."""
        agrees = len(self._offs) == WINDOW and sum(self._offs) < MOST_OFF_TOGETHER
        return self._inner.is_from_scans and not agrees

    def _checked(self, proposed: Proposed) -> OdometryResult:
        """The scan with its pose and the result of its check, if one is due."""
        if not self._is_due(proposed):
            self._num_unchecked += 1
            self._motion.follow(self._since_last(proposed.T_odom_lidar), proposed.gap)
            return proposed.at(proposed.T_odom_lidar, Motion(MotionState.UNCHECKED))
        self._num_unchecked = 0
        if proposed.scan.is_small:
            return self._of_few_points(proposed)
        if len(self._map) == 0:
            self._map.add(proposed.T_odom_lidar, proposed.scan)
            return proposed.at(proposed.T_odom_lidar, Motion(MotionState.UNCHECKED))
        confirmed = None if self._is_watched or proposed.gap > 1.0 else self._confirmed(proposed)
        return confirmed or self._registered(proposed)

    def _is_due(self, proposed: Proposed) -> bool:
        """True if the motion is as long as a keyframe's since the last checked scan, or unlike the last motion.

        And for a scan too small to show it, with which KISS-ICP moves at random.
        """
        if len(self._map) == 0 or self._is_watched or proposed.gap > 1.0 or self._num_unchecked >= MOST_UNCHECKED:
            return True
        if proposed.scan.is_small:
            return True
        moved_m = geometry.displacement_m(proposed.scan.moments, proposed.T_odom_lidar, self._map.T_odom_map)
        sudden_m = geometry.displacement_m(proposed.scan.moments, proposed.T_odom_lidar, proposed.T_odom_predicted)
        return moved_m >= self._config.keyframes.distance_m or sudden_m >= self._map.voxel_m

    def _confirmed(self, proposed: Proposed) -> OdometryResult | None:
        """The proposed pose, if a few steps to the last checked scan leave it and fit as usual; else None."""
        T_map_proposed = self._map.pose_of(proposed.T_odom_lidar)
        found = self._map.check(proposed.scan, T_map_proposed)
        if found is None or (off := _off(found.T_map_lidar, self._covariance(found), T_map_proposed)) > MOST_OFF:
            return None
        fits_as_usual = _fits_as_usual(found, self._last_checks)
        self._last_checks.append(found.mean_log)
        if not fits_as_usual:
            return None
        if not self._inner.is_from_scans:
            return self._kept(proposed, found, is_unsure=False)
        T_last_lidar = self._since_last(proposed.T_odom_lidar)
        if _off(*self._motion.fused(T_last_lidar, self._covariance(found), proposed.gap), T_last_lidar) > MOST_OFF:
            return None  # the last motions say more than the scan does
        self._offs.append(off)
        _, covariance = self._motion.update(T_last_lidar, self._covariance(found), proposed.gap)
        self._map.add(proposed.T_odom_lidar, proposed.scan)
        return proposed.at(
            proposed.T_odom_lidar, self._result(MotionState.CONFIRMED, T_map_proposed, found, covariance)
        )

    def _registered(self, proposed: Proposed) -> OdometryResult:
        """The most likely pose of the scan in the local map."""
        gap, before = proposed.gap, self._map
        search, fits = self._poses(proposed)
        is_rejoined = self._map is not before
        if not is_rejoined:
            proposed, search, fits = self._swept(proposed, search, fits)
        scan = proposed.scan
        T_odom_map, T_map_proposed = self._map.T_odom_map, self._map.pose_of(proposed.T_odom_lidar)
        by_chance = 0.0
        elsewhere = float(is_rejoined)  # the scan before is not in the map before a break
        if not is_rejoined and not self._is_usual(fits):
            by_chance = self._by_chance(search, fits, gap)
            elsewhere = max(search.elsewhere(self._fused(fits, gap)), by_chance)
            if elsewhere * ELSEWHERE_M**2 > BREAK_M**2 or not self._motion.is_known:
                recognised = search.without_guess(self._recover)
                if recognised and (not fits or search.log_ratio(recognised[0], fits[0]) >= 0.0):
                    fits, elsewhere, by_chance = recognised, 0.0, 0.0
        best = fits[0] if fits else self._map.fit(scan, T_map_proposed)
        self._last_fits.append(best.mean_log)
        unsure = search.spread(self._fused(fits, gap)) + elsewhere * np.diag(ANYWHERE**2)
        is_unsure = bool(unsure[3:, 3:].max() > BREAK_M**2)
        if not self._inner.is_from_scans and (is_unsure or not self._contradicts(search, fits, proposed)):
            return self._kept(proposed, best, is_unsure=is_unsure)
        is_lost = elsewhere > 0.5 and not is_rejoined
        T_step_before = self._motion.T_step
        T_last_lidar = geometry.nearest_transform(self._since_last(T_odom_map) @ best.T_map_lidar)
        covariance = own = self._covariance(best)
        if by_chance < 0.5:  # a pose by chance does not show the speed
            own = self._motion.fused(T_last_lidar, covariance, gap)[1]
            T_last_lidar, covariance = self._motion.update(T_last_lidar, covariance, gap)
        T_odom_lidar, covariance = geometry.nearest_transform(self._T_odom_last @ T_last_lidar), covariance + unsure
        off = _off(T_odom_lidar, own + unsure, proposed.T_odom_lidar)
        is_unlikely = off > MOST_OFF and _is_significant(search, best, self._map.fit(scan, T_map_proposed))
        state = self._state(off, covariance, is_unlikely=is_unlikely)
        if state is MotionState.CONFIRMED:
            T_odom_lidar = proposed.T_odom_lidar
        if is_lost:
            self._lost = self._lost or (self._map, T_step_before, gap)
            self._map = LocalMap(self._config.refine)
            self._motion.begin_map()
        self._map.add(T_odom_lidar, scan)
        self._follow(state, T_odom_lidar)
        return proposed.at(T_odom_lidar, self._result(state, T_map_proposed, best, covariance))

    def _of_few_points(self, proposed: Proposed) -> OdometryResult:
        """The pose of a scan with too few points to show its motion: that of other sensors, or the predicted one.

        KISS-ICP aligns even a few points, at any pose.
        """
        T_odom_lidar, gap = proposed.T_odom_lidar, proposed.gap
        if not self._inner.is_from_scans or not self._motion.predicts:
            return proposed.at(T_odom_lidar, Motion(MotionState.UNCHECKED))
        T_last_lidar, covariance = self._motion.update(self._motion.predicted(gap), np.diag(ANYWHERE**2), gap)
        T_odom_continued = geometry.nearest_transform(self._T_odom_last @ T_last_lidar)
        state = self._state(_off(T_odom_continued, covariance, T_odom_lidar), covariance, is_unlikely=True)
        if state is not MotionState.CONFIRMED:
            T_odom_lidar = T_odom_continued
        self._follow(state, T_odom_lidar)
        return proposed.at(
            T_odom_lidar, Motion(state, information=self._own_information(covariance), covariance=covariance)
        )

    def _follow(self, state: MotionState, T_odom_lidar: Transform) -> None:
        """Let the odometry continue from the pose and the local map here, if its own pose was replaced."""
        if state in (MotionState.REPAIRED, MotionState.BROKEN):
            self._inner.follow(self._map.scans, T_odom_lidar, self._motion.T_step)
            self._T_odom_inner = np.eye(4)

    def _poses(self, proposed: Proposed) -> tuple[PoseSearch, list[Fit]]:
        """Poses in the local map, which may be that before a break again, the most likely first; and their search."""
        search = self._search(proposed)
        starts = [self._map.pose_of(T) for T in (proposed.T_odom_lidar, proposed.T_odom_predicted)]
        fits = search.near(starts)
        rejoined = self._rejoined(proposed, fits)
        if rejoined is not None:
            return rejoined
        T_map_last = self._map.pose_of(self._T_odom_last)
        if not self._is_found(search, fits, starts):
            starts.append(T_map_last)
            fits = search.near([T_map_last], fits)
        if not self._is_found(search, fits, starts):
            fits = search.around(T_map_last, self._since_last(proposed.T_odom_predicted), fits)
        return search, fits

    def _search(self, proposed: Proposed) -> PoseSearch:
        """The search in the local map, where motions like the last ones are more probable."""
        T_last_map = self._since_last(self._map.T_odom_map)

        def prior(fit: Fit) -> float:
            return self._motion.log_prior(T_last_map @ fit.T_map_lidar, self._covariance(fit), proposed.gap)

        return PoseSearch(self._map, proposed.scan, prior=prior)

    def _swept(self, proposed: Proposed, search: PoseSearch, fits: list[Fit]) -> tuple[Proposed, PoseSearch, list[Fit]]:
        """The same with the points moved by the motion during the sweep that the most likely pose shows.

        They stay if they have no times, or hardly differ.
        """
        for _ in range(NUM_SWEPT):
            T_before = proposed.result.T_sweep
            if T_before is None or not fits:
                break
            T_odom_middle = at_middle(proposed.raw, self._map.T_odom_map @ fits[0].T_map_lidar, T_before)
            T_sweep = self._sweeps.motion(T_odom_middle, proposed.gap)
            least_m = LEAST_SIGMA_VOXELS * self._map.voxel_m
            if T_sweep is None or geometry.displacement_m(proposed.scan.moments, T_before, T_sweep) < least_m:
                break
            result = swept_by(proposed.raw, proposed.result, T_sweep, self._config.odometry)
            moved = proposed._replace(result=result, scan=SeenScan(result.points, self._config.refine))
            again = self._search(moved)
            found = again.near([fit.T_map_lidar for fit in fits])
            if not found:
                break
            proposed, search, fits = moved, again, found
        return proposed, search, fits

    def _since_last(self, T_odom_lidar: Transform) -> Transform:
        """The motion since the last scan."""
        return geometry.inverse(self._T_odom_last) @ T_odom_lidar

    def _fused(self, fits: Sequence[Fit], gap: float) -> list[Fit]:
        """The poses fused with the last motions: those along a wall are one where the scan shows no motion along it."""
        T_last_map = self._since_last(self._map.T_odom_map)
        fused = []
        for fit in fits:
            T_last_lidar, _ = self._motion.fused(T_last_map @ fit.T_map_lidar, self._covariance(fit), gap)
            fused.append(replace(fit, T_map_lidar=geometry.inverse(T_last_map) @ T_last_lidar))
        return fused

    def _by_chance(self, search: PoseSearch, fits: Sequence[Fit], gap: float) -> float:
        """Probability that the scan is far from all poses that were tried, so that the best one fits by chance.

        After a gap the sensor may be anywhere: the prior is that of the motion, the evidence the score of loops. Where
        the best pose contradicts the last motions, these do not show either where else the sensor may be.
        """
        untried = self._motion.may_exceed(search.far_m, gap)
        if fits and fits[0].log_prior < math.log(1.0 - INLIER_PROBABILITY):
            untried = 1.0
        if not fits or untried < SIGNIFICANT:
            return untried
        return untried / (1.0 + math.exp(search.log_odds(fits[0])))

    def _contradicts(self, search: PoseSearch, fits: Sequence[Fit], proposed: Proposed) -> bool:
        """True if the most probable pose is significantly more probable than the proposed one, or any near it."""
        T_map_proposed = self._map.pose_of(proposed.T_odom_lidar)
        near = [fit for fit in fits if search.is_same(fit.T_map_lidar, T_map_proposed)]
        others = [*near, self._map.fit(proposed.scan, T_map_proposed)]
        return all(_is_significant(search, fits[0], fit) for fit in others)

    def _kept(self, proposed: Proposed, best: Fit, *, is_unsure: bool) -> OdometryResult:
        """The pose of an odometry of other sensors, which the scans do not contradict."""
        T_map_proposed = self._map.pose_of(proposed.T_odom_lidar)
        self._map.add(proposed.T_odom_lidar, proposed.scan)
        self._motion.restart(geometry.scaled(self._since_last(proposed.T_odom_lidar), 1.0 / proposed.gap))
        state = MotionState.UNCHECKED if is_unsure else MotionState.CONFIRMED
        return proposed.at(proposed.T_odom_lidar, self._result(state, T_map_proposed, best, None))

    def _rejoined(self, proposed: Proposed, here: Sequence[Fit]) -> tuple[PoseSearch, list[Fit]] | None:
        """Poses in the map before a break, if it explains the scan as usual and at least as well as `here`.

        It is then the local map again. `here`: the poses in the present local map. The break may have been a scan that
        nothing explains; the motion before it then continued.
        """
        if self._lost is None:
            return None
        local, T_step, since = self._lost
        since += proposed.gap
        search = PoseSearch(local, proposed.scan)
        T_continued = geometry.scaled(T_step, since)
        by_odometry = [local.pose_of(T) for T in (proposed.T_odom_lidar, proposed.T_odom_predicted)]
        fits = search.around(np.eye(4), T_step, search.near([*by_odometry, np.eye(4), T_continued]))
        if self._is_usual(fits) and (not here or fits[0].mean_log >= here[0].mean_log):
            self._map, self._lost = local, None
            return search, fits
        self._lost = None if since > WINDOW else (local, T_step, since)
        return None

    def _is_found(self, search: PoseSearch, fits: Sequence[Fit], T_map_starts: Sequence[Transform]) -> bool:
        """True if the most likely pose is near one of the starts, and explains the scan as usual or has a good score.

        A registration that leads away from where it started may have ended at the first of several local optima.
        """
        if not fits or not any(search.is_same(fits[0].T_map_lidar, T_start) for T_start in T_map_starts):
            return False
        return self._is_usual(fits) or search.log_odds(fits[0]) > -math.log(SIGNIFICANT)

    def _is_usual(self, fits: Sequence[Fit]) -> bool:
        """True if the most likely pose explains the scan as usual; False if there is none."""
        return bool(fits) and _fits_as_usual(fits[0], self._last_fits)

    def _state(self, off: float, covariance: Information, *, is_unlikely: bool) -> MotionState:
        """Name of the result. `off`, which is noted, and `is_unlikely` compare the odometry's pose with the one kept.

        An odometry that agreed with the last registrations is repaired only where its pose explains the scan worse.
        """
        is_break = float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) > BREAK_M**2
        is_watched, is_off = self._is_watched, off > MOST_OFF
        is_repaired = is_off and (is_watched or is_unlikely)
        if is_repaired or is_break:
            self._offs.clear()
            return MotionState.BROKEN if is_break else MotionState.REPAIRED
        self._offs.append(off)
        return MotionState.REFINED if is_watched or is_off else MotionState.CONFIRMED

    def _covariance(self, fit: Fit) -> Information:
        """Covariance of a registered pose: of its likelihood, `ANYWHERE` at most, and of errors of all points."""
        return np.linalg.inv(fit.information + np.diag(ANYWHERE**-2.0)) + SHARED_NOISE

    def _result(
        self, state: MotionState, T_map_proposed: Transform, fit: Fit, covariance: Information | None
    ) -> Motion:
        off = geometry.inverse(T_map_proposed) @ fit.T_map_lidar
        if covariance is not None and state is MotionState.CONFIRMED:  # the pose is the proposed one, not the fit
            covariance = covariance + np.outer(geometry.log(off), geometry.log(off))
        return Motion(
            state,
            geometry.distance(off),
            float(np.degrees(geometry.angle(off))),
            fit.overlap,
            fit.rms_m,
            information=None if covariance is None else self._own_information(covariance),
            covariance=covariance,
        )

    def _own_information(self, covariance: Information) -> Information | None:
        """Information of a motion that is less certain than the graph's noise model of odometry; else None."""
        step = geometry.transform(np.eye(3), np.array([self._config.keyframes.distance_m, 0.0, 0.0]))
        model = np.linalg.inv(odometry_information(0.0, step, self._config.graph)) + SHARED_NOISE
        whiten = np.diag(np.diag(model) ** -0.5)
        excess, directions = np.linalg.eigh(whiten @ (covariance - model) @ whiten)
        if excess[-1] <= 0.0:
            return None
        half = np.linalg.inv(whiten) @ directions
        return np.linalg.inv(model + (half * np.maximum(excess, 0.0)) @ half.T)


def _fits_as_usual(fit: Fit, last: Collection[float]) -> bool:
    """True if a pose explains its scan at most three standard deviations worse than the median of the last ones.

    The standard deviation is that of a normal distribution with the same median absolute deviation, and at least that
    of the mean of the patches. False if nothing is known of the last ones.
    """
    if not last:
        return False
    middle = median(last)
    spread = 1.4826 * median(abs(other - middle) for other in last)
    return fit.mean_log >= middle - 3.0 * max(spread, fit.num_patches**-0.5)


def _is_significant(search: PoseSearch, fit: Fit, other: Fit) -> bool:
    """True if the scan makes a pose significantly more probable than another, whatever the last motions were."""
    return search.log_ratio(fit, other) > -math.log(SIGNIFICANT)


def _off(T_known: Transform, covariance: Information, T_other: Transform) -> float:
    """Chi-square of the difference between a pose with this covariance and another one."""
    offset = geometry.log(geometry.inverse(T_known) @ T_other)
    return float(offset @ np.linalg.solve(covariance, offset))
