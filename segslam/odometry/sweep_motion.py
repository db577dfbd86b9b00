"""The motion of the sensor during a sweep, by which the points of the sweep are moved to its end."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from segslam.core import geometry
from segslam.core.types import Scan, Tangent, Transform
from segslam.odometry.motion_model import LEAST_KNOWN, WINDOW


class SweepMotion:
    """The motion during a sweep, by the poses of the sensor at the middle of this and of the last two sweeps.

    The middle is the mean time of the points. A registration shows where the sensor was then, by whatever motion its
    points are moved to the end; the pose at the end has half the error of that motion. Motions from end to end would
    never lose such an error: if one end is too far ahead, the next is as far behind.
    """

    def __init__(self) -> None:
        self._T_odom_middle: Transform | None = None
        self._step: Tangent | None = None
        """Motion per interval between the last two middles."""
        self._changes: deque[Tangent] = deque(maxlen=WINDOW)
        """Of these motions, from each to the next."""

    def motion(self, T_odom_middle: Transform, gap: float) -> Transform | None:
        """The motion per interval at the middle of a sweep; None without a last sweep.

        It is the motion since the last middle, and half as much of its change as is not noise.
        """
        step = self._step_to(T_odom_middle, gap)
        if step is None:
            return None
        if self._step is None or gap > 1.0:
            return geometry.exp(step)
        change = step - self._step
        return geometry.exp(step + 0.5 * _steady_share([*self._changes, change]) * change)

    def note(self, T_odom_middle: Transform, gap: float, *, is_break: bool) -> None:
        """Note the pose at the middle of a sweep; the motion to one after a break is unknown."""
        step = None if is_break else self._step_to(T_odom_middle, gap)
        if step is not None and self._step is not None:
            self._changes.append(step - self._step)
        self._T_odom_middle, self._step = T_odom_middle, step

    def _step_to(self, T_odom_middle: Transform, gap: float) -> Tangent | None:
        if self._T_odom_middle is None:
            return None
        return geometry.log(geometry.inverse(self._T_odom_middle) @ T_odom_middle) / gap


def _steady_share(changes: Sequence[Tangent]) -> Tangent:
    """(6,) share of the variance of changes that is not noise of the poses; 0 while it is unknown.

    Changes a of a steady acceleration repeat; independent errors of poses with variance s add 6 s to their variance, as
    second differences, and -4 s to their covariance from one to the next.
    """
    if len(changes) < LEAST_KNOWN:
        return np.zeros(6)
    values = np.array(changes)
    variance, covariance = np.mean(values**2, axis=0), np.mean(values[1:] * values[:-1], axis=0)
    ratio = np.divide(covariance, variance, out=np.zeros(6), where=variance > 0.0)
    return np.clip(0.4 + 0.6 * ratio, 0.0, 1.0)


def at_middle(scan: Scan, T_odom_lidar: Transform, T_sweep: Transform) -> Transform:
    """The pose at the middle of a sweep, from that at its end, to which its points are moved by `T_sweep`."""
    return T_odom_lidar @ geometry.scaled(T_sweep, float(np.mean(scan.times)) - 1.0)
