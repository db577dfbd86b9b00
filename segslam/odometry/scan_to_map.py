"""The most likely pose of each scan in the local map, among those to which proposals lead, and how sure it is.

Proposals are the odometry's motion and the last motion; and, if no pose near a proposal explains the scan as scans of
this drive usually are explained or has a good score, no motion and poses all around, and by place recognition. Once it
is known what is usual, a few steps from the odometry's pose suffice where they explain the scan so, and those from the
last motion end there, too. Where several poses explain the scan nearly as well, the one with the usual motion is the
most likely. Points with times are moved to the end of their sweep by the motion that the pose shows, and the scan is
registered again.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from statistics import median
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config, RefineConfig
from segslam.core.probabilities import INLIER_PROBABILITY, SIGNIFICANT
from segslam.core.types import Information, Motion, Points, Scan, Transform
from segslam.graph.edges import BREAK_M
from segslam.odometry.likelihood import LEAST_SIGMA_VOXELS, Correlation, Fit
from segslam.odometry.local_map import LocalMap, SeenScan
from segslam.odometry.motion_model import WINDOW, MotionModel
from segslam.odometry.nudge import NUM_POINTS
from segslam.odometry.search import PoseSearch, Recover
from segslam.odometry.sweep import OdometryResult, swept_by
from segslam.odometry.sweep_motion import SweepMotion, at_middle
from segslam.registration.refinement import SHARED_NOISE

ELSEWHERE_M = 30.0
ANYWHERE = geometry.tangent(rotation_rad=np.radians(60.0), translation_m=ELSEWHERE_M)
"""Chosen: standard deviations of a motion that no pose explains: the sensor may have been carried anywhere nearby."""
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


class Registered(NamedTuple):
    """The most likely pose of a scan, and what else is possible."""

    proposed: Proposed
    """The scan; its points may have been moved."""
    search: PoseSearch
    fits: list[Fit]
    """The poses that were found, the most likely first; none if no registration succeeded."""
    best: Fit
    """The first of them, or the proposed one."""
    unsure: Information
    """(6, 6) covariance of the choice between poses, tangent in the scan's frame."""
    is_lost: bool
    """True if the scan is probably at no pose in the map: it begins another one."""
    is_by_chance: bool
    """True if the pose probably fits by chance, so that it does not show the speed."""

    @property
    def is_unsure(self) -> bool:
        """True if the choice is as unsure as a break."""
        return bool(self.unsure[3:, 3:].max() > BREAK_M**2)

    @property
    def T_map_proposed(self) -> Transform:  # noqa: N802  (a transform)
        """The odometry's pose in the map."""
        return self.search.local.pose_of(self.proposed.T_odom_lidar)

    def contradicts_proposed(self) -> bool:
        """True if the scan contradicts the odometry's pose, and all poses that were found near it."""
        near = [fit for fit in self.fits if self.search.is_same(fit.T_map_lidar, self.T_map_proposed)]
        proposed = self.search.local.fit(self.proposed.scan, self.T_map_proposed)
        return all(self.contradicts(fit) for fit in [*near, proposed])

    def contradicts(self, other: Fit) -> bool:
        """True if the scan makes the best pose significantly more probable than another, whatever the motions were."""
        return self.search.log_ratio(self.best, other) > -math.log(SIGNIFICANT)


class ScanToMap:
    """Registers scans with the last ones, in the local map; or in the map before a break, if they are there again."""

    def __init__(self, config: Config, *, recover: Recover) -> None:
        """`recover` registers two clouds without initial guess."""
        self._config = config
        self._recover = recover
        self._correlation = Correlation(WINDOW)
        self._refine: RefineConfig | None = None
        self.local = LocalMap(config.refine, self._correlation)
        self._lost: tuple[LocalMap, Transform, float] | None = None
        """The map before a break, in which the next scans are tried, the motion per interval there, and the intervals
        since then."""
        self.motion = MotionModel()
        self.T_odom_last = np.eye(4)
        """Pose of the last scan."""
        self._last_fits: deque[float] = deque(maxlen=WINDOW)
        """How well the last scans that were registered were explained."""
        self._sweeps = SweepMotion()

    def seen(self, points: Points) -> SeenScan:
        """A scan, downsampled with the voxels that the first scan decides.

        They are half as large if this has fewer points than are registered in the usual ones, and more than twice as
        many then: half the edge means four times as many voxels on a surface that is seen densely, and as many on one
        of which each point has its own.
        """
        if self._refine is None:
            usual = self._config.refine
            finer = usual.model_copy(update={"voxel_m": 0.5 * usual.voxel_m})
            num_usual, num_finer = (len(SeenScan(points, config).thinned) for config in (usual, finer))
            self._refine = finer if 2 * num_usual < min(num_finer, 2 * NUM_POINTS) else usual
            self.local = LocalMap(self._refine, self._correlation)
        return SeenScan(points, self._refine)

    def register(self, proposed: Proposed) -> Registered:
        """The most likely pose of a scan; the map before a break may become the local map again."""
        gap, before = proposed.gap, self.local
        search, fits = self._poses(proposed)
        is_rejoined = self.local is not before
        if not is_rejoined:
            proposed, search, fits = self._swept(proposed, search, fits)
        by_chance = 0.0
        elsewhere = float(is_rejoined)  # the scan before is not in the map before a break
        if not is_rejoined and not self._is_usual(fits):
            by_chance = self._by_chance(search, fits, gap)
            elsewhere = max(search.elsewhere(self._fused(fits, gap)), by_chance)
            if elsewhere * ELSEWHERE_M**2 > BREAK_M**2 or not self.motion.is_known:
                recognised = search.without_guess(self._recover)
                if recognised and (not fits or search.log_ratio(recognised[0], fits[0]) >= 0.0):
                    fits, elsewhere, by_chance = recognised, 0.0, 0.0
        best = fits[0] if fits else self.local.fit(proposed.scan, self.local.pose_of(proposed.T_odom_lidar))
        self._last_fits.append(best.mean_log)
        if fits:
            self._correlation.note(best)
        unsure = search.spread(self._fused(fits, gap)) + elsewhere * np.diag(ANYWHERE**2)
        is_lost = elsewhere > 0.5 and not is_rejoined
        return Registered(proposed, search, fits, best, unsure, is_lost=is_lost, is_by_chance=by_chance >= 0.5)

    def covariance(self, fit: Fit) -> Information:
        """Covariance of a registered pose: of its likelihood, `ANYWHERE` at most, and of errors of all points."""
        return np.linalg.inv(fit.information + np.diag(ANYWHERE**-2.0)) + SHARED_NOISE

    def since_last(self, T_odom_lidar: Transform) -> Transform:
        """The motion since the last scan."""
        return geometry.inverse(self.T_odom_last) @ T_odom_lidar

    def leave_map(self, T_step: Transform, gap: float) -> None:
        """Begin another map; the next scans are tried in this one, too. `T_step`: the motion per interval there."""
        self._lost = self._lost or (self.local, T_step, gap)
        self.local = LocalMap(self._refine or self._config.refine, self._correlation)
        self.motion.begin_map()

    def end_scan(self, scan: Scan, result: OdometryResult, gap: float) -> None:
        """Note the pose of a scan, which is then the last one."""
        if result.T_sweep is not None:
            is_break = result.motion is not None and result.motion.is_break
            self._sweeps.note(at_middle(scan, result.T_odom_lidar, result.T_sweep), gap, is_break=is_break)
        self.T_odom_last = result.T_odom_lidar

    def _poses(self, proposed: Proposed) -> tuple[PoseSearch, list[Fit]]:
        """Poses in the local map, which may be that before a break again, the most likely first; and their search."""
        search = self._search(proposed)
        starts = [self.local.pose_of(T) for T in (proposed.T_odom_lidar, proposed.T_odom_predicted)]
        fits = search.beside(starts) if len(self._last_fits) == WINDOW and proposed.gap == 1.0 else []
        if not self._is_usual(fits):
            fits = search.near(starts)
        rejoined = self._rejoined(proposed, fits)
        if rejoined is not None:
            return rejoined
        T_map_last = self.local.pose_of(self.T_odom_last)
        if not self._is_found(search, fits, starts):
            starts.append(T_map_last)
            fits = search.near([T_map_last], fits)
        if not self._is_found(search, fits, starts):
            fits = search.around(T_map_last, self.since_last(proposed.T_odom_predicted), fits)
        return search, fits

    def _search(self, proposed: Proposed) -> PoseSearch:
        """The search in the local map, where motions like the last ones are more probable."""
        T_last_map = self.since_last(self.local.T_odom_map)

        def prior(fit: Fit) -> float:
            return self.motion.log_prior(T_last_map @ fit.T_map_lidar, self.covariance(fit), proposed.gap)

        return PoseSearch(self.local, proposed.scan, prior=prior)

    def _swept(self, proposed: Proposed, search: PoseSearch, fits: list[Fit]) -> tuple[Proposed, PoseSearch, list[Fit]]:
        """The same with the points moved by the motion during the sweep that the most likely pose shows.

        They stay if they have no times, or hardly differ.
        """
        for _ in range(NUM_SWEPT):
            T_before = proposed.result.T_sweep
            if T_before is None or not fits:
                break
            T_odom_middle = at_middle(proposed.raw, self.local.T_odom_map @ fits[0].T_map_lidar, T_before)
            T_sweep = self._sweeps.motion(T_odom_middle, proposed.gap)
            least_m = LEAST_SIGMA_VOXELS * self.local.voxel_m
            if T_sweep is None or geometry.displacement_m(proposed.scan.moments, T_before, T_sweep) < least_m:
                break
            result = swept_by(proposed.raw, proposed.result, T_sweep, self._config.odometry)
            moved = proposed._replace(result=result, scan=self.seen(result.points))
            again = self._search(moved)
            found = again.near([fit.T_map_lidar for fit in fits])
            if not found:
                break
            proposed, search, fits = moved, again, found
        return proposed, search, fits

    def _fused(self, fits: Sequence[Fit], gap: float) -> list[Fit]:
        """The poses fused with the last motions: those along a wall are one where the scan shows no motion along it."""
        T_last_map = self.since_last(self.local.T_odom_map)
        fused = []
        for fit in fits:
            T_last_lidar, _ = self.motion.fused(T_last_map @ fit.T_map_lidar, self.covariance(fit), gap)
            fused.append(replace(fit, T_map_lidar=geometry.inverse(T_last_map) @ T_last_lidar))
        return fused

    def _by_chance(self, search: PoseSearch, fits: Sequence[Fit], gap: float) -> float:
        """Probability that the scan is far from all poses that were tried, so that the best one fits by chance.

        After a gap the sensor may be anywhere: the prior is that of the motion, the evidence the score of loops. Where
        the best pose contradicts the last motions, these do not show either where else the sensor may be.
        """
        untried = self.motion.may_exceed(search.local.reach_m, gap)
        if fits and fits[0].log_prior < math.log(1.0 - INLIER_PROBABILITY):
            untried = 1.0
        if not fits or untried < SIGNIFICANT:
            return untried
        return untried / (1.0 + math.exp(search.log_odds(fits[0])))

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
            self.local, self._lost = local, None
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
        """True if the most likely pose explains its scan at most three standard deviations worse than the last ones.

        The standard deviation, about the median, is that of a normal distribution with the same median absolute
        deviation, and at least that of the mean of the patches. False without a pose, or if nothing is known of the
        last ones.
        """
        if not fits or not self._last_fits:
            return False
        middle = median(self._last_fits)
        spread = 1.4826 * median(abs(other - middle) for other in self._last_fits)
        return fits[0].mean_log >= middle - 3.0 * max(spread, fits[0].num_patches ** -0.5)
