"""Duration of a sweep, measured on scans whose points carry no times.

A spinning LiDAR measures the points of a sweep one after the other while it moves. Without times they are not moved to
one time, and the scan stays distorted: in a bend by metres at large distances. The duration of the sweep is measured
(`distortion`) for each azimuth at which a sweep may begin; the azimuth that explains most is kept, and the duration is
the one that leaves none.
"""

from functools import cache

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t as student

from segslam.candidates.proximity import BREAK_TRAVEL_M
from segslam.core.config import RefineConfig
from segslam.core.trajectory import Poses
from segslam.core.types import Vector
from segslam.odometry.checked import SIGNIFICANT
from segslam.registration.refinement import LightSurface, downsample
from segslam.slam.adjustment.correction import Correction, Sweep, Velocities, swept
from segslam.slam.adjustment.distortion import MOST_PAIRS, PointsOf, Shown, shown
from segslam.slam.adjustment.submaps import STEPS

FROM_DEG = np.arange(0.0, 360.0, 45.0)
"""Chosen: azimuths at which a sweep may begin, so that an eighth of the points at most is on the wrong side."""


def measure_sweep(
    points_of: PointsOf, T_world: Poses, travel_m: Vector, velocities: Velocities, *, config: RefineConfig
) -> Sweep | None:
    """The sweep by pairs of keyframes of a drive; None if too few show one, or not significantly.

    `travel_m` (n,): length of the path.
    """
    pairs = _pairs(travel_m, velocities)
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
    chance = len(FROM_DEG) * 2.0 * student.sf(abs(seconds) / first.sigma[best], first.num_pairs - 1)
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


def _pairs(travel_m: Vector, velocities: Velocities) -> list[tuple[int, int]]:
    """(older, newer) keyframes in which the sensor turned fastest, each in one pair, so that pairs are independent."""
    older = np.arange(max(len(travel_m) - STEPS[0], 0))
    older = older[travel_m[older + STEPS[0]] - travel_m[older] < BREAK_TRAVEL_M]
    turning = np.linalg.norm(velocities.per_second[:, :3], axis=1)
    chosen: list[tuple[int, int]] = []
    used = set[int]()
    for first in older[np.argsort(-(turning[older] + turning[older + STEPS[0]]))].tolist():
        if len(chosen) < MOST_PAIRS and not used & {first, first + STEPS[0]}:
            used |= {first, first + STEPS[0]}
            chosen.append((first, first + STEPS[0]))
    return chosen
