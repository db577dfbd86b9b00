"""Corrections of the points of keyframes: for the motion within a sweep, and for the vertical angle of the beams.

A spinning LiDAR measures the points of a sweep one after the other while it moves. Without times they are not moved to
one time, and the scan stays distorted: in a bend by metres at large distances. The duration of the sweep is measured
(`shown`) for each azimuth at which a sweep may begin; the azimuth that explains most is kept, and the duration is
the one that leaves none.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.special import stdtr

from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.probabilities import SIGNIFICANT
from segslam.core.trajectory import Poses
from segslam.core.types import Indices, Motion, Points, Tangent, Trajectory, Vector
from segslam.registration.refinement import LightSurface, downsample
from segslam.slam.adjustment.alignment import MOST_PAIRS, PointsOf, Shown, shown
from segslam.slam.adjustment.submaps import STEPS

FROM_DEG = np.arange(0.0, 360.0, 45.0)
"""Chosen: azimuths at which a sweep may begin, so that an eighth of the points at most is on the wrong side."""


class Velocities(NamedTuple):
    """How the sensor moves while it measures the scans of keyframes, by the odometry."""

    per_second: Float[np.ndarray, "n 6"]
    """Tangent of the motion in each keyframe's frame, per second."""
    interval_s: float
    """Usual time between scans; no sweep takes longer."""


def velocities_of(odometry: Trajectory, rows: Indices, motions: Sequence[Motion]) -> Velocities:
    """From the scans before and after the one of each keyframe (`rows`), where no break is between them."""
    last = len(odometry) - 1
    after_break = [*(motion.is_break for motion in motions), *[False] * (last + 1 - len(motions)), True]
    after_break[0] = True
    T, stamp_ns = odometry.T_world_lidar, odometry.stamp_ns
    found = np.zeros((len(rows), 6))
    for number, row in enumerate(rows.tolist()):
        a, b = row - (not after_break[row]), row + (not after_break[row + 1])
        seconds = 1e-9 * float(stamp_ns[b] - stamp_ns[a])
        if seconds > 0.0:
            found[number] = geometry.log(geometry.inverse(T[a]) @ T[b]) / seconds
    intervals = np.diff(stamp_ns)
    return Velocities(found, 1e-9 * float(np.median(intervals)) if len(intervals) else 0.0)


class Sweep(NamedTuple):
    """How a spinning LiDAR measured scans whose points were not moved to one time."""

    seconds: float
    """Duration of a sweep; negative if the beams turn clockwise, seen from above."""
    sigma_s: float
    from_deg: float
    """Azimuth at which a sweep begins, from the x axis to the left."""


def swept(points: Points, velocity: Tangent, from_deg: float) -> Points:
    """(n, 3) m per second of a sweep that turns to the left: how far each point moves to the time of the middle.

    `velocity`: motion of the sensor per second. At a phase t between -1/2 and 1/2 of a sweep of d seconds, a point p
    was measured from where the sensor was t d seconds after the middle.
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0]) - np.radians(from_deg)
    phase = np.mod(azimuth / (2.0 * np.pi), 1.0) - 0.5
    return phase[:, None] * (np.cross(velocity[:3], points) + velocity[3:])


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The correction of the points of one keyframe."""

    raised_deg: float = 0.0
    """Elevation added to the points."""
    sweep: Sweep | None = None
    """The sweep within which the sensor moved; None if the points were measured, or were moved, to one time."""
    velocity: Tangent | None = None
    """Motion of the sensor per second; needed with a sweep."""

    def __call__(self, points: Points) -> Points:
        """The corrected points (n, 3), in the frame of the sensor at the middle of the sweep; of the same dtype."""
        if self.sweep is not None and self.velocity is not None:
            moved = self.sweep.seconds * swept(points.astype(np.float64), self.velocity, self.sweep.from_deg)
            points = (points + moved).astype(points.dtype)
        return geometry.raise_beams(points, self.raised_deg)


def corrections_of(raised_deg: float, sweep: Sweep | None, velocities: Velocities) -> list[Correction]:
    """The correction of each keyframe of a drive."""
    return [Correction(raised_deg, sweep, velocity) for velocity in velocities.per_second]


def corrected_by(corrections: Sequence[Correction], points_of: PointsOf) -> PointsOf:
    """Returns the points of a keyframe with its correction."""
    return lambda keyframe_id: corrections[keyframe_id](points_of(keyframe_id))


def common_sweep(sweeps: Sequence[Sweep | None]) -> Sweep | None:
    """The mean of the sweeps of several drives, weighted by their errors; None if they are not of one kind."""
    known = [sweep for sweep in sweeps if sweep is not None]
    if len(known) < len(sweeps) or len({(sweep.from_deg, sweep.seconds > 0.0) for sweep in known}) != 1:
        return None
    seconds: Vector = np.array([sweep.seconds for sweep in known])
    weights = np.array([sweep.sigma_s for sweep in known]) ** -2.0
    return Sweep(float(np.average(seconds, weights=weights)), float(weights.sum() ** -0.5), known[0].from_deg)


def measure_sweep(
    points_of: PointsOf, T_world: Poses, num_breaks: Indices, velocities: Velocities, *, config: RefineConfig
) -> Sweep | None:
    """The sweep by pairs of keyframes of a drive; None if too few show one, or not significantly.

    `num_breaks` (n,): number of breaks before each keyframe.
    """
    pairs = _pairs(num_breaks, velocities)
    per_second = velocities.per_second

    @cache
    def left(seconds: float, from_deg: float) -> Shown | None:
        """What pairs show beyond a sweep by which their scans are corrected."""

        def surface(keyframe_id: int) -> LightSurface:
            correction = Correction(0.0, Sweep(seconds, 0.0, from_deg), per_second[keyframe_id])
            return LightSurface(downsample(correction(points_of(keyframe_id)), config=config))

        return shown(
            pairs,
            surface,
            T_world,
            lambda keyframe_id, points: np.array([swept(points, per_second[keyframe_id], deg) for deg in FROM_DEG]),
        )

    first = left(0.0, 0.0)
    if first is None:
        return None
    best = int(np.argmax(first.gain))
    seconds, from_deg = float(first.value[best]), float(FROM_DEG[best])
    chance = len(FROM_DEG) * 2.0 * stdtr(first.num_pairs - 1, -abs(seconds) / first.sigma[best])
    if not chance < SIGNIFICANT:  # nor if it is unknown
        return None

    def left_s(duration_s: float) -> float:
        found = left(duration_s, from_deg if duration_s else 0.0)
        return 0.0 if found is None else float(found.value[best])

    longest_s = float(np.copysign(velocities.interval_s, seconds))
    if left_s(longest_s) * seconds >= 0.0:
        return None  # no sweep takes longer than the time between scans
    duration_s = float(brentq(left_s, 0.0, longest_s, xtol=float(first.sigma[best])))
    last = left(duration_s, from_deg)
    if last is None:
        return None
    share = (seconds - float(last.value[best])) / duration_s
    return Sweep(duration_s + float(last.value[best]) / share, float(last.sigma[best]) / share, from_deg)


def _pairs(num_breaks: Indices, velocities: Velocities) -> list[tuple[int, int]]:
    """(older, newer) keyframes in which the sensor turned fastest, each in one pair, so that pairs are independent."""
    older = np.arange(max(len(num_breaks) - STEPS[0], 0))
    older = older[num_breaks[older + STEPS[0]] == num_breaks[older]]
    turning = np.linalg.norm(velocities.per_second[:, :3], axis=1)
    chosen: list[tuple[int, int]] = []
    used = set[int]()
    for first in older[np.argsort(-(turning[older] + turning[older + STEPS[0]]))].tolist():
        if len(chosen) < MOST_PAIRS and not used & {first, first + STEPS[0]}:
            used |= {first, first + STEPS[0]}
            chosen.append((first, first + STEPS[0]))
    return chosen
