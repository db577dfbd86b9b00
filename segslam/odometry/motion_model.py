"""Prediction of the next motion, and its covariance: a Kalman filter whose noise is learnt from the drive.

The state is the motion of the sensor per interval. It is predicted to stay the same; how much motions change is
measured on the last ones. Where the scans constrain the pose, the prediction has no weight. Where they do not, as along
a tunnel, the motion continues as before, and its covariance grows from scan to scan. A later scan may show the position
again, relative to scans from before: the last motion, from a wrong position to the right one, is then as uncertain as
the change is large.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from statistics import median

import numpy as np
from scipy.linalg import eigh

from segslam.core import geometry
from segslam.core.probabilities import log_chance
from segslam.core.types import Information, Motion, Scan, Transform, Vector
from segslam.odometry.local_map import MAP_SCANS

WINDOW = 30
"""Chosen: number of scans from which the usual values of a drive are learnt."""
LEAST_KNOWN = 5
"""Chosen: number of values from which a median and a spread are known."""
LONG_GAP = 1.5
"""Chosen: a time between scans above this many usual intervals means that scans are missing."""
CHI_SQUARE_MEDIAN = 0.455
"""Median of the chi-square distribution with one degree of freedom."""


class Intervals:
    """The usual time between scans, and gaps."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        """The latest stamp."""
        self._intervals_s: deque[float] = deque(maxlen=WINDOW)

    @property
    def usual_s(self) -> float:
        """The usual time between scans; 0 if it is unknown."""
        return median(self._intervals_s) if self._intervals_s else 0.0

    def gap(self, stamp_ns: int, since_ns: int | None = None) -> float:
        """Time since a stamp, by default the latest, in usual intervals; 1 if no scan is missing, or it is unknown."""
        since_ns = self.last_ns if since_ns is None else since_ns
        interval_s = 0.0 if since_ns is None else (stamp_ns - since_ns) * 1e-9
        if interval_s <= 0.0 or not self._intervals_s:
            return 1.0
        gap = interval_s / self.usual_s
        return gap if gap > LONG_GAP else 1.0

    def spanned(self, scan: Scan) -> Scan:
        """The scan with times of which 0 and 1 are a usual interval apart: the sweep is shorter if scans are left out.

        The odometry takes the motion from scan to scan as that from 0 to 1. An interval up to `LONG_GAP` sweeps is one.
        """
        since_last_s = 0.0 if self.last_ns is None else (scan.stamp_ns - self.last_ns) * 1e-9
        usual_s = self.usual_s or since_last_s
        if scan.sweep_s <= 0.0 or usual_s <= LONG_GAP * scan.sweep_s:
            return scan
        share = scan.sweep_s / usual_s
        stamp_time = 1.0 - share * (1.0 - scan.stamp_time)
        return replace(scan, times=1.0 - share * (1.0 - scan.times), stamp_time=stamp_time, sweep_s=usual_s)

    def note(self, stamp_ns: int) -> None:
        """Note the stamp of a scan."""
        if self.last_ns is not None and stamp_ns > self.last_ns:
            self._intervals_s.append((stamp_ns - self.last_ns) * 1e-9)
        self.last_ns = stamp_ns if self.last_ns is None else max(stamp_ns, self.last_ns)


class MotionModel:
    """The motion per interval and its covariance, updated with the motion of each scan."""

    def __init__(self) -> None:
        self.T_step: Transform = np.eye(4)
        """Motion per interval of the sensor."""
        self._covariance: Information | None = None
        self._accumulated = np.zeros((6, 6))
        """Covariance of the error of the position since the last observation with that of the motion per interval."""
        self._unseen: deque[Information] = deque(maxlen=MAP_SCANS)
        """Covariances of the motions that the scans of the map did not show, as tangents of the last scan."""
        self._changes: deque[np.ndarray] = deque(maxlen=WINDOW)

    @property
    def is_known(self) -> bool:
        """True once a motion was measured; the first has no prediction, and an odometry is easily wrong there."""
        return self._covariance is not None

    @property
    def predicts(self) -> bool:
        """True once it is known how much motions change."""
        return len(self._changes) >= LEAST_KNOWN

    def predicted(self, gap: float) -> Transform:
        """The motion over `gap` intervals, if it does not change."""
        return geometry.scaled(self.T_step, gap)

    def restart(self, T_step: Transform) -> None:
        """Continue with a motion per interval that is known exactly."""
        self.T_step, self._covariance, self._accumulated = T_step, None, np.zeros((6, 6))
        self._unseen.clear()

    def _predicted_covariance(self, gap: float) -> Information | None:
        """(6, 6) of the predicted motion; None while too few motions are known."""
        if not self.predicts:
            return None
        noise = np.diag(np.median(np.square(self._changes), axis=0) / CHI_SQUARE_MEDIAN)
        before = np.zeros((6, 6)) if self._covariance is None else self._covariance
        return gap**2 * (before + gap * noise)

    def log_prior(self, T_last_lidar: Transform, measured: Information, gap: float) -> float:
        """Log of the largest probability of a motion, measured with this covariance, as unlike the predicted one.

        0 while nothing is known of the motion.
        """
        prior = self._predicted_covariance(gap)
        if prior is None:
            return 0.0
        change = geometry.log(geometry.inverse(self.predicted(gap)) @ T_last_lidar)
        return log_chance(float(change @ np.linalg.solve(prior + measured, change)), len(change))

    def may_exceed(self, reach_m: float, gap: float) -> float:
        """Probability that the motion over `gap` intervals ends farther than `reach_m` from the predicted one.

        It is 0 while nothing is known of the motion.
        """
        prior = self._predicted_covariance(gap)
        return 0.0 if prior is None else geometry.chance_beyond(reach_m, prior)

    def fused(self, T_last_lidar: Transform, measured: Information, gap: float) -> tuple[Transform, Information]:
        """The most likely motion since the last scan, given a measured one with its covariance and the prediction.

        With the covariance of this motion alone, which has no part in the errors of those before.
        """
        T_fused, gain, prior = self._fuse(T_last_lidar, measured, gap)
        return T_fused, _posterior(gain, prior, measured)

    def update(self, T_last_lidar: Transform, measured: Information, gap: float) -> tuple[Transform, Information]:
        """As `fused`, with the covariance of the result; it becomes the motion that predicts the next one.

        The covariance is the increase of that of the position: errors of predicted motions add up linearly.
        """
        T_fused, gain, prior = self._fuse(T_last_lidar, measured, gap)
        regained = np.zeros(6) if prior is None else self._regained(T_fused, prior, gap)
        if gap == 1.0 and (prior is None or (np.diag(measured) < np.diag(prior)).all()):  # else the scan shows it worse
            self._changes.append(geometry.log(geometry.inverse(self.T_step) @ T_last_lidar))
        left = np.eye(6) - gain
        posterior = _posterior(gain, prior, measured)
        carried = np.zeros((6, 6)) if prior is None else gap * self._accumulated @ left.T
        self._covariance, self._accumulated = posterior / gap**2, (carried + posterior) / gap
        added, directions = eigh(carried + carried.T, posterior)
        half = posterior @ directions
        total = posterior + (half * np.maximum(added, 0.0)) @ half.T  # errors that cancel may not be counted on
        self.follow(T_fused, gap)
        self._unseen.append(left @ total @ left.T)
        return T_fused, total + np.outer(regained, regained)

    def follow(self, T_last_lidar: Transform, gap: float) -> None:
        """Continue with the motion of a scan; its covariance remains that of the motions before."""
        self.T_step = geometry.scaled(T_last_lidar, 1.0 / gap)
        turn = np.kron(np.eye(2), T_last_lidar[:3, :3].T)
        self._unseen = deque([turn @ covariance @ turn.T for covariance in self._unseen], MAP_SCANS)

    def begin_map(self) -> None:
        """Continue with a map of the last scan alone, which shows nothing of the positions before."""
        self._unseen.clear()

    def _regained(self, T_fused: Transform, prior: Information, gap: float) -> Vector:
        """(6,) by how much the scan may correct the last position instead of showing another motion.

        The change has two causes: the motion changed, with covariance `prior`, or the last position was wrong. The
        share of its square in each direction is the probability of the second, by their covariances.
        """
        if not self._unseen:
            return np.zeros(6)
        ratios, directions = eigh(sum(self._unseen), prior)
        change = geometry.log(geometry.inverse(self.predicted(gap)) @ T_fused)
        probability = np.maximum(ratios, 0.0) / (1.0 + np.maximum(ratios, 0.0))
        return prior @ directions @ (np.sqrt(probability) * (directions.T @ change))

    def _fuse(
        self, T_last_lidar: Transform, measured: Information, gap: float
    ) -> tuple[Transform, Information, Information | None]:
        """The fused motion, the Kalman gain, and the covariance of the prediction; None if nothing is known of it."""
        prior = self._predicted_covariance(gap)
        if prior is None:
            return T_last_lidar, np.eye(6), None
        T_predicted = self.predicted(gap)
        change = geometry.log(geometry.inverse(T_predicted) @ T_last_lidar)
        # a change that the scans show may be larger than all before, in any direction: a turn tells nothing of a slide
        prior = prior + np.diag(np.repeat([change[:3] @ change[:3], change[3:] @ change[3:]], 3))
        gain = prior @ np.linalg.inv(prior + measured)
        return geometry.nearest_transform(T_predicted @ geometry.exp(gain @ change)), gain, prior


def _posterior(gain: np.ndarray, prior: Information | None, measured: Information) -> Information:
    """Covariance of a prediction and a measurement together, in Joseph's form: positive after any rounding."""
    if prior is None:
        return measured
    left = np.eye(6) - gain
    return left @ prior @ left.T + gain @ measured @ gain.T


def information_of(motions: Sequence[Motion]) -> Information | None:
    """Information of successive motions together; None if none has an information of its own.

    Their covariances are added: the motions between two keyframes are too short for their lever arms to matter.
    """
    own = [motion.information for motion in motions if motion.information is not None]
    return np.linalg.inv(sum(np.linalg.inv(information) for information in own)) if own else None
