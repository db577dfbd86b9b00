"""An odometry whose motions are replaced by the most likely ones, given the map of the last scans.

Every scan is registered with the last ones (`scan_to_map`), from the pose of the odometry and others, and the most
likely pose is kept; a given odometry keeps its poses where the scans do not contradict them. After a repair the
odometry continues from the local map; smaller corrections leave it undisturbed, and are added to its following poses.
A scan with too few points to show its motion moves on as the last ones did.
"""

import numpy as np
from scipy.special import chdtri

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.probabilities import SIGNIFICANT
from segslam.core.types import Information, Motion, MotionState, Scan, Transform
from segslam.graph.edges import BREAK_M
from segslam.graph.noise import odometry_information
from segslam.odometry.likelihood import Fit
from segslam.odometry.motion_model import Intervals
from segslam.odometry.scan_to_map import ANYWHERE, Proposed, ScanToMap
from segslam.odometry.search import Recover
from segslam.odometry.sweep import Foreseeing, Odometry, OdometryResult, at_stamp
from segslam.registration.refinement import SHARED_NOISE

MOST_OFF = float(chdtri(6, SIGNIFICANT))
"""Chi-square above which a pose of the odometry is significantly off the registered one."""


class CheckedOdometry:
    """Another odometry with its motions checked and replaced by more likely ones."""

    def __init__(self, inner: Odometry, config: Config, *, recover: Recover) -> None:
        """`recover` registers two clouds without initial guess."""
        self._inner = inner
        self._config = config
        self._scans = ScanToMap(config, recover=recover)
        self._motion = self._scans.motion
        self._intervals = Intervals()
        self._T_odom_inner: Transform = np.eye(4)
        """Pose of the frame in which the inner odometry continues, undisturbed by small corrections."""

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
        T_odom_predicted = self._scans.T_odom_last @ self._motion.predicted(gap)
        seen = self._scans.seen(result.points)
        proposed = Proposed(scan, result, seen, self._T_odom_inner @ result.T_odom_lidar, T_odom_predicted, gap)
        checked = self._checked(proposed)
        assert checked.motion
        self._scans.end_scan(scan, checked, gap)
        if checked.motion.state is MotionState.REFINED:
            T_inner_odom = geometry.inverse(result.T_odom_lidar)
            self._T_odom_inner = geometry.nearest_transform(checked.T_odom_lidar @ T_inner_odom)
        return at_stamp(scan, checked)

    def _checked(self, proposed: Proposed) -> OdometryResult:
        """The scan with the most likely pose."""
        if proposed.scan.is_small:
            return self._of_few_points(proposed)
        if len(self._scans.local) == 0:
            self._scans.local.add(proposed.T_odom_lidar, proposed.scan)
            return proposed.at(proposed.T_odom_lidar, Motion(MotionState.UNCHECKED))
        return self._registered(proposed)

    def _registered(self, proposed: Proposed) -> OdometryResult:
        """The most likely pose of the scan in the local map."""
        scans, motion, gap = self._scans, self._motion, proposed.gap
        found = scans.register(proposed)
        proposed, T_map_proposed = found.proposed, found.T_map_proposed
        if not self._inner.is_from_scans and (found.is_unsure or not found.contradicts_proposed()):
            return self._kept(proposed, found.best, is_unsure=found.is_unsure)
        T_step_before = motion.T_step
        T_last_map = scans.since_last(scans.local.T_odom_map)
        T_last_lidar = geometry.nearest_transform(T_last_map @ found.best.T_map_lidar)
        covariance = own = scans.covariance(found.best)
        if not found.is_by_chance:
            own = motion.fused(T_last_lidar, covariance, gap)[1]
            T_last_lidar, covariance = motion.update(T_last_lidar, covariance, gap)
        covariance = covariance + found.unsure
        T_odom_lidar = geometry.nearest_transform(scans.T_odom_last @ T_last_lidar)
        state = _state(_off(T_odom_lidar, own + found.unsure, proposed.T_odom_lidar), covariance)
        if found.is_lost:
            scans.leave_map(T_step_before, gap)
        scans.local.add(T_odom_lidar, proposed.scan)
        self._follow(state, T_odom_lidar)
        return proposed.at(T_odom_lidar, self._result(state, T_map_proposed, found.best, covariance))

    def _of_few_points(self, proposed: Proposed) -> OdometryResult:
        """The pose of a scan with too few points to show its motion: that of other sensors, or the predicted one.

        KISS-ICP aligns even a few points, at any pose.
        """
        T_odom_lidar, gap = proposed.T_odom_lidar, proposed.gap
        if not self._inner.is_from_scans or not self._motion.predicts:
            return proposed.at(T_odom_lidar, Motion(MotionState.UNCHECKED))
        T_last_lidar, covariance = self._motion.update(self._motion.predicted(gap), np.diag(ANYWHERE**2), gap)
        T_odom_continued = geometry.nearest_transform(self._scans.T_odom_last @ T_last_lidar)
        state = _state(_off(T_odom_continued, covariance, T_odom_lidar), covariance)
        self._follow(state, T_odom_continued)
        return proposed.at(
            T_odom_continued, Motion(state, information=self._own_information(covariance), covariance=covariance)
        )

    def _follow(self, state: MotionState, T_odom_lidar: Transform) -> None:
        """Let the odometry continue from the pose and the local map here, if its own pose was replaced."""
        if state in (MotionState.REPAIRED, MotionState.BROKEN):
            self._inner.follow(self._scans.local.scans, T_odom_lidar, self._motion.T_step)
            self._T_odom_inner = np.eye(4)

    def _kept(self, proposed: Proposed, best: Fit, *, is_unsure: bool) -> OdometryResult:
        """The pose of an odometry of other sensors, which the scans do not contradict."""
        T_map_proposed = self._scans.local.pose_of(proposed.T_odom_lidar)
        self._scans.local.add(proposed.T_odom_lidar, proposed.scan)
        self._motion.restart(geometry.scaled(self._scans.since_last(proposed.T_odom_lidar), 1.0 / proposed.gap))
        state = MotionState.UNCHECKED if is_unsure else MotionState.CONFIRMED
        return proposed.at(proposed.T_odom_lidar, self._result(state, T_map_proposed, best, None))

    def _result(
        self, state: MotionState, T_map_proposed: Transform, fit: Fit, covariance: Information | None
    ) -> Motion:
        off = geometry.inverse(T_map_proposed) @ fit.T_map_lidar
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
        """Information of a motion that is less certain than the graph's noise model of odometry; else None.

        The model grows by as much as the covariance exceeds it and the errors that all points share. So it has no jump:
        a motion that is as certain as usual has the model alone, whatever the points share.
        """
        step = geometry.transform(np.eye(3), np.array([self._config.keyframes.distance_m, 0.0, 0.0]))
        model = np.linalg.inv(odometry_information(0.0, step, self._config.graph))
        usual = model + SHARED_NOISE
        whiten = np.diag(np.diag(usual) ** -0.5)
        excess, directions = np.linalg.eigh(whiten @ (covariance - usual) @ whiten)
        if excess[-1] <= 0.0:
            return None
        half = np.linalg.inv(whiten) @ directions
        return np.linalg.inv(model + (half * np.maximum(excess, 0.0)) @ half.T)


def _state(off: float, covariance: Information) -> MotionState:
    """Name of a registered motion; `off`: chi-square of the odometry's pose, compared with the one kept."""
    if float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) > BREAK_M**2:
        return MotionState.BROKEN
    return MotionState.REPAIRED if off > MOST_OFF else MotionState.REFINED


def _off(T_known: Transform, covariance: Information, T_other: Transform) -> float:
    """Chi-square of the difference between a pose with this covariance and another one."""
    offset = geometry.log(geometry.inverse(T_known) @ T_other)
    return float(offset @ np.linalg.solve(covariance, offset))
