"""Vertical angle of a LiDAR, measured on submaps of one drive that are some metres apart.

If all beams point lower than assumed, every plane is measured as a cone around the sensor (`shown`). An odometry
that registers such scans explains part of the angle by a pitch in every motion. The angle is therefore corrected in the
scans, before the odometry (`sensor.vertical_angle_deg`).

Positive angles: the points of a scan are too low and have to be raised by the angle.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config, RefineConfig, SensorCalibrationConfig
from segslam.core.probabilities import INLIER_PROBABILITY, sigmas_beyond
from segslam.core.trajectory import Poses
from segslam.core.types import Points, Scan, Transform, Vector
from segslam.keyframes import KeyframeSelector, downsample_keyframe
from segslam.labels.label_files import unlabelled
from segslam.odometry.kiss import KissOdometry
from segslam.registration.refinement import downsample
from segslam.slam.adjustment.alignment import MIN_PAIRS, MOST_PAIRS, SEARCH_M, PointsOf, Shown, shown
from segslam.slam.adjustment.submaps import surfaces_of

APART_M = (20.0, 30.0)
"""Travel between the two submaps of a pair, in turn. Chosen on KITTI 00, thin and dense scans; between single scans the
angle depends on the distance, because the rings of two of them may lie on each other."""
MOST_DEG = math.degrees(SEARCH_M[-1] / max(APART_M))
"""1.3 degrees: larger angles move points at the distance of a pair by more than paired points may be apart."""
MOST_APART = 1.5
"""Pairs are dropped if their straight distance is less than their travel divided by this, or more than their travel
times this: the sensor stood still, or keyframes are missing."""
MOST_TURN_RAD = math.radians(30.0)
"""Chosen: after larger rotations, scans share less of the scene."""
BIAS_DEG = 0.05
"""Standard deviation added to that of the mean, for what distorts surfaces otherwise: grass seems higher from afar.
Chosen: KITTI 00 shows 0.18 of 0.205 degrees, a campus (NCLT) -0.04 of 0, simulated streets 0.09 of 0.03."""
INLIER_SIGMAS = sigmas_beyond(1.0 - INLIER_PROBABILITY)
"""An angle is significant above so many standard deviations, 0.129 degrees or more."""


@dataclass(frozen=True, slots=True)
class VerticalAngle:
    """The remaining vertical angle of some scans; positive if their points are too low."""

    angle_deg: float
    sigma_deg: float
    num_pairs: int
    share: float = 1.0
    """Part of an angle that the pairs show."""

    @property
    def is_significant(self) -> bool:
        """True if the angle differs from zero by more than its error."""
        return abs(self.angle_deg) > INLIER_SIGMAS * self.sigma_deg

    @property
    def correction_deg(self) -> float:
        """Elevation to be added to the points: the angle, or 0 if it is not significant."""
        return self.angle_deg if self.is_significant else 0.0


def vertical_angle_advice(metrics: Mapping[str, Any], sensor: SensorCalibrationConfig) -> str:
    """A line about the vertical angle of a run: its correction, or the setting for it; empty if not significant."""
    if "vertical_deg" not in metrics:
        return ""
    found = VerticalAngle(metrics["vertical_deg"], metrics["vertical_sigma_deg"], MIN_PAIRS)
    if not found.is_significant:
        return ""
    if metrics.get("vertical_correction_deg"):
        return f"{described(found)}; the adjustment and the map are corrected by it"
    total_deg = found.angle_deg + (sensor.vertical_angle_deg or 0.0)
    return f"{described(found)}; map again with --set sensor.vertical_angle_deg={total_deg:.2f}"


def described(found: VerticalAngle) -> str:
    """The angle as text."""
    side = "low" if found.angle_deg >= 0 else "high"
    return f"beams point {abs(found.angle_deg):.2f} +- {found.sigma_deg:.2f} degrees {side}"


def measure_vertical_angle(
    points_of: PointsOf,
    T_world: Poses,
    travel_m: Vector,
    *,
    config: RefineConfig,
    motion_variance: Vector | None = None,
    near: VerticalAngle | None = None,
) -> VerticalAngle | None:
    """The vertical angle by pairs of submaps that are some metres apart; None if too few pairs determine it.

    An angle within `BIAS_DEG` is as they show it. Of a larger one they hide a part: it is the correction that leaves
    none, by a line through what they show without one and with one of twice that; None above `MOST_DEG`.
    `motion_variance` (n,): as of `is_known`, by default of exact poses. `near`: a measurement with poses that were
    worse, whose correction and share are used.
    """
    variance = np.zeros(len(travel_m)) if motion_variance is None else motion_variance
    thinned = cache(lambda keyframe_id: downsample(points_of(keyframe_id), config=config))
    pairs = _pairs(T_world, travel_m)

    def left_of(correction_deg: float) -> Shown | None:
        """What pairs show beyond a correction."""

        def raised(keyframe_id: int) -> Points:
            return geometry.raise_beams(thinned(keyframe_id), correction_deg)

        surface_of = surfaces_of(raised, T_world, variance, config=config)
        return shown(pairs, surface_of, T_world, lambda _, points: np.radians(geometry.raising(points))[None])

    correction_deg = 0.0 if near is None else near.angle_deg
    found = left_of(correction_deg)
    if found is None:
        return None
    left_deg, sigma_deg = float(found.value[0]), float(found.sigma[0])
    if near is not None:
        share = near.share
    elif abs(left_deg) < BIAS_DEG:
        share = 1.0
    else:
        tried_deg = 2.0 * left_deg
        beyond = left_of(tried_deg)
        if beyond is None:
            return None
        share = (left_deg - float(beyond.value[0])) / tried_deg
        if not share > 0.0:
            return None
    angle_deg = correction_deg + left_deg / share
    if abs(angle_deg) > MOST_DEG:
        return None
    return VerticalAngle(angle_deg, math.hypot(sigma_deg / share, BIAS_DEG), found.num_pairs, share)


class Calibrator:
    """Measures the vertical angle of the scans of one drive, without labels and map. It stores keyframes only."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._odometry = KissOdometry(config.odometry)
        self._selector = KeyframeSelector(config.keyframes)
        self._kept: list[tuple[Points, Transform, float]] = []
        """Points, pose and travel of each keyframe."""

    @property
    def travel_m(self) -> float:
        """Length of the path so far (m)."""
        return self._selector.travel_m

    def add(self, scan: Scan) -> None:
        """Add the next scan in order of time. Raises BadScan, and ignores the scan, if it cannot be used."""
        registered = self._odometry.register(scan)
        if self._selector.update(registered.T_odom_lidar):
            kept = downsample_keyframe(
                registered.points, unlabelled(len(registered.points)), config=self._config.keyframes, whole_classes=()
            )[0]
            thinned = downsample(kept, config=self._config.refine)
            self._kept.append((thinned, registered.T_odom_lidar, self.travel_m))

    def vertical_angle(self) -> VerticalAngle | None:
        """The remaining vertical angle of the scans so far; None if too few of them determine it."""
        if not self._kept:
            return None
        points, T_odom, travel_m = zip(*self._kept, strict=True)
        refine = self._config.refine
        return measure_vertical_angle(points.__getitem__, np.stack(T_odom), np.array(travel_m), config=refine)


def _pairs(T_world: Poses, travel_m: Vector) -> list[tuple[int, int]]:
    """(older, newer) keyframes some distances apart, evenly along the drive, without a sharp turn between them."""
    pairs = []
    for target in range(len(travel_m)):
        apart_m = APART_M[target % len(APART_M)]
        source = int(np.searchsorted(travel_m, travel_m[target] + apart_m))
        if source == len(travel_m):
            continue
        T_target_source = geometry.inverse(T_world[target]) @ T_world[source]
        is_apart = apart_m / MOST_APART < geometry.distance(T_target_source) < apart_m * MOST_APART
        if is_apart and geometry.angle(T_target_source) < MOST_TURN_RAD:
            pairs.append((target, source))
    rows = np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_PAIRS)).astype(int)
    return [pairs[row] for row in rows]
