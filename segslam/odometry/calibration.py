"""Calibration of a LiDAR's vertical angle from scans of one drive that are some metres apart.

If all beams point lower than assumed, every plane is measured as a cone around the sensor. Scans from different places
then distort one surface differently, and no rigid motion aligns them: the angle is a seventh unknown of their
registration. An odometry that registers such scans explains part of the angle by a pitch in every motion. The angle is
therefore corrected in the scans, before the odometry (`sensor.vertical_angle_deg`).

Positive angles: the points of a scan are too low and have to be raised by the angle.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from segslam.core import geometry
from segslam.core.config import Config, RefineConfig, SensorCalibrationConfig
from segslam.core.geometry import raising
from segslam.core.types import Mask, Points, Scan, Transform, Vector
from segslam.keyframes import KeyframeSelector
from segslam.keyframes import downsample_keyframe as thin_keyframe
from segslam.labels.label_files import unlabelled
from segslam.odometry import KissOdometry, Odometry
from segslam.registration.refinement import LightSurface, downsample

PointsOf = Callable[[int], Points]
"""Returns the points of a keyframe, by id, in its own frame."""

APART_M = (20.0, 30.0)
"""Travel between the two submaps of a pair, in turn. Chosen on KITTI 00, thin and dense scans, where the angles are
0.19 degrees at 20 and 30 m, 0.16 to 0.18 at 10 m. Single scans have 0.11 to 0.19, depending on the distance: the rings
of two of them may lie on each other."""
REACH = 2
"""Number of keyframes before and after one in its submap; those nearer than half of the way to the other submap."""
MOST_APART = 1.5
"""Pairs are dropped if their straight distance is less than their travel divided by this, or more than their travel
times this: the sensor stood still, or keyframes are missing."""
MOST_PAIRS = 40
"""Number of pairs measured, twice. Chosen: the error of the median is then a third of `BIAS_DEG` or less, in 3 s."""
MIN_PAIRS = 8
"""Chosen: the scatter of fewer pairs is too uncertain."""
MOST_TURN_RAD = math.radians(30.0)
"""Chosen: after larger rotations, scans share less of the scene."""
MOST_POINTS = 4000
"""Number of points of the source. Chosen: 1500 points change the median by 0.02 degrees, and lose pairs."""
SEARCH_M = (1.0, 0.8, 0.6, *[0.5] * 17)
"""Search distance of each step. Chosen: the error of the odometry over 10 m is below the first."""
CONVERGED = 2e-3
"""The iteration ends after a step smaller than this (rad, m)."""
SETTLED_RAD = math.radians(0.03)
"""Largest change of the angle in the last step if the iteration does not converge, because point pairs still change.
Chosen: half of the scatter between pairs of KITTI's scans."""
RESIDUAL_M = 0.05
"""Distance at which the weight of a point is a quarter. Chosen: above the noise of ranges."""
LEVEL_NORMAL_Z, STANDING_NORMAL_Z = 0.95, 0.15
"""Chosen: surfaces that are neither horizontal nor vertical are mostly foliage."""
MIN_PAIRED = 500
"""Chosen: fewer matching points do not come from a dense scan of a street."""
MOST_SIGMA_DEG = 0.05
"""Pairs with a larger standard deviation of the angle, from their residuals, are dropped. Chosen: 0.01 for KITTI's
submaps, 0.02 for those of 32 beams."""
BIAS_DEG = 0.05
"""Standard deviation added to that of the median, for what distorts surfaces otherwise: grass seems higher from afar.
Chosen: KITTI 00 shows 0.18 of 0.205 degrees, a campus (NCLT) -0.08 of 0, simulated streets 0.07 of 0.03."""
SIGNIFICANT_SIGMAS = 2.5
"""Chosen: an angle is significant above so many standard deviations, 0.125 degrees or more."""


class AngleShown(NamedTuple):
    """The vertical angle that pairs of submaps show: a part of it, because their scans are distorted."""

    median_deg: float
    error_deg: float
    """Standard error of the median of normal errors."""
    num_pairs: int


@dataclass(frozen=True, slots=True)
class VerticalAngle:
    """The remaining vertical angle of some scans; positive if their points are too low."""

    angle_deg: float
    sigma_deg: float
    num_pairs: int
    shown: AngleShown | None = None
    """Angle that submaps of the scans without correction show; None if it is not known."""

    @property
    def is_significant(self) -> bool:
        """True if the angle differs from zero by more than its error."""
        return abs(self.angle_deg) > SIGNIFICANT_SIGMAS * self.sigma_deg

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
    T_odom_keyframes: Float[np.ndarray, "n 4 4"],
    travel_m: Vector,
    *,
    config: RefineConfig,
) -> VerticalAngle | None:
    """The vertical angle by pairs of submaps that are some metres apart; None if too few pairs determine it.

    An angle within `BIAS_DEG` is as they show it; of a larger one they hide a part (`leaving_none`).
    """
    shown = angle_shown(points_of, T_odom_keyframes, travel_m, 0.0, config=config)
    if shown is None:
        return None
    if abs(shown.median_deg) < BIAS_DEG:
        return VerticalAngle(shown.median_deg, math.hypot(shown.error_deg, BIAS_DEG), shown.num_pairs, shown)
    return leaving_none(shown, shown.median_deg, points_of, T_odom_keyframes, travel_m, config=config)


def leaving_none(
    shown: AngleShown,
    correction_deg: float,
    points_of: PointsOf,
    T_odom_keyframes: Float[np.ndarray, "n 4 4"],
    travel_m: Vector,
    *,
    config: RefineConfig,
) -> VerticalAngle | None:
    """The correction after which submaps show no angle, by what they show before any and after one.

    It falls in proportion to the correction. None if it does not fall, or if too few pairs determine it.
    """
    left = angle_shown(points_of, T_odom_keyframes, travel_m, correction_deg, config=config)
    share = 0.0 if left is None else (shown.median_deg - left.median_deg) / correction_deg
    if left is None or share <= 0.0:
        return None
    angle_deg = correction_deg + left.median_deg / share
    return VerticalAngle(angle_deg, math.hypot(left.error_deg / share, BIAS_DEG), left.num_pairs, shown)


def angle_shown(
    points_of: PointsOf,
    T_odom_keyframes: Float[np.ndarray, "n 4 4"],
    travel_m: Vector,
    correction_deg: float,
    *,
    config: RefineConfig,
) -> AngleShown | None:
    """The angle that pairs of submaps of corrected scans show; None if too few determine it."""

    @lru_cache(2)
    def surface(keyframe_id: int) -> LightSurface:
        near = range(max(keyframe_id - REACH, 0), min(keyframe_id + REACH + 1, len(travel_m)))
        clouds = [
            geometry.apply(
                geometry.inverse(T_odom_keyframes[keyframe_id]) @ T_odom_keyframes[one],
                geometry.raise_beams(downsample(points_of(one), config=config), correction_deg),
            )
            for one in near
            if abs(travel_m[one] - travel_m[keyframe_id]) < APART_M[0] / 2.0
        ]
        return LightSurface(downsample(np.vstack(clouds), config=config))

    found = []
    for target, source in _pairs(T_odom_keyframes, travel_m):
        T_prior = geometry.inverse(T_odom_keyframes[target]) @ T_odom_keyframes[source]
        one = register_with_angle(surface(source), surface(target), T_prior)
        if one is not None and one.sigma_rad < math.radians(MOST_SIGMA_DEG):
            found.append(math.degrees(one.angle_rad))
    if len(found) < MIN_PAIRS:
        return None
    median = float(np.median(found))
    spread = 1.4826 * float(np.median(np.abs(np.array(found) - median)))
    return AngleShown(median, math.sqrt(math.pi / 2 / len(found)) * spread, len(found))


class Calibrator:
    """Measures the vertical angle of the scans of one drive, without labels and map. It stores keyframes only."""

    def __init__(self, config: Config, *, odometry: Odometry | None = None) -> None:
        self._config = config
        self._odometry = odometry or KissOdometry(config.odometry)
        self._selector = KeyframeSelector(config.keyframes)
        self._points: list[Points] = []
        self._T_odom_keyframes: list[Transform] = []
        self._travel_m: list[float] = []

    @property
    def travel_m(self) -> float:
        """Length of the path so far (m)."""
        return self._selector.travel_m

    def add(self, scan: Scan) -> None:
        """Add the next scan in order of time. Raises BadScan, and ignores the scan, if it cannot be used."""
        registered = self._odometry.register(scan)
        if self._selector.update(registered.T_odom_lidar):
            kept = thin_keyframe(
                registered.points, unlabelled(len(registered.points)), config=self._config.keyframes, whole_classes=()
            )[0]
            self._points.append(downsample(kept, config=self._config.refine))
            self._T_odom_keyframes.append(registered.T_odom_lidar)
            self._travel_m.append(self._selector.travel_m)

    def vertical_angle(self) -> VerticalAngle | None:
        """The remaining vertical angle of the scans so far; None if too few of them determine it."""
        if not self._points:
            return None
        poses, travel_m = np.stack(self._T_odom_keyframes), np.array(self._travel_m)
        return measure_vertical_angle(
            self._points.__getitem__,
            poses,
            travel_m,
            config=self._config.refine,
        )


@dataclass(frozen=True, slots=True, eq=False)
class PairAngle:
    """The pose of one scan in another, and their common vertical angle."""

    T_target_source: Transform
    angle_rad: float
    sigma_rad: float
    """Standard deviation of the angle for independent errors of the points."""


def register_with_angle(source: LightSurface, target: LightSurface, T_target_source: Transform) -> PairAngle | None:
    """Estimate pose and angle together, starting at an initial guess of the pose.

    Minimises point-to-plane distances under the Geman-McClure kernel. Returns None if too few points match, or the
    angle does not converge.
    """
    if min(len(source), len(target)) < MIN_PAIRED:
        return None
    points = source.points[_is_clear(source.normals_at(np.arange(len(source))))]
    points = points[:: math.ceil(max(len(points), 1) / MOST_POINTS)]
    angle_rad = 0.0
    for search_m in SEARCH_M:
        nearest, distance_m = target.nearest(geometry.apply(T_target_source, points))
        rows = np.flatnonzero(distance_m < search_m)
        normals = target.normals_at(nearest[rows])
        clear = _is_clear(normals)
        rows, normals = rows[clear], normals[clear]
        if len(rows) < MIN_PAIRED:
            return None
        step, sigma_rad = _step(points[rows], target.points[nearest[rows]], normals, T_target_source, angle_rad)
        T_target_source = T_target_source @ geometry.exp(step[:6])
        angle_rad += float(step[6])
        if np.linalg.norm(step) < CONVERGED:
            break
    return PairAngle(T_target_source, angle_rad, sigma_rad) if abs(step[6]) < SETTLED_RAD else None


def _is_clear(normals: Points) -> Mask:
    """(n,) bool: whether each surface is horizontal or vertical, like ground and walls."""
    upward = np.abs(normals[:, 2])
    return (upward > LEVEL_NORMAL_Z) | (upward < STANDING_NORMAL_Z)


def _step(
    source: Points, target: Points, normals: Points, T_target_source: Transform, angle_rad: float
) -> tuple[Float[np.ndarray, "7"], float]:
    """One Gauss-Newton step from matched points: tangent of the pose and change of the angle; sigma of the angle."""
    raising_source, raising_target = raising(source), raising(target)
    raised = source + angle_rad * raising_source
    moved = geometry.apply(T_target_source, raised)
    residual_m = np.einsum("ij,ij->i", normals, moved - target - angle_rad * raising_target)
    normals_source = normals @ T_target_source[:3, :3]
    by_angle = (normals_source * raising_source - normals * raising_target).sum(axis=1)
    jacobian = np.column_stack([np.cross(raised, normals_source), normals_source, by_angle])
    weight = (1.0 + (residual_m / RESIDUAL_M) ** 2) ** -2
    weighted = jacobian * weight[:, None]
    hessian = weighted.T @ jacobian
    variance = float(weight @ residual_m**2 / weight.sum()) * float(np.linalg.pinv(hessian)[6, 6])
    known = np.linalg.cond(hessian) < 1e12  # otherwise a direction, perhaps the angle, is undetermined
    return -np.linalg.lstsq(hessian, weighted.T @ residual_m)[0], math.sqrt(variance) if known else math.inf


def _pairs(T_odom_keyframes: np.ndarray, travel_m: Vector) -> list[tuple[int, int]]:
    """(older, newer) keyframes some distances apart, evenly along the drive, without a sharp turn between them."""
    pairs = []
    for target in range(len(travel_m)):
        apart_m = APART_M[target % len(APART_M)]
        source = int(np.searchsorted(travel_m, travel_m[target] + apart_m))
        if source == len(travel_m):
            continue
        T_target_source = geometry.inverse(T_odom_keyframes[target]) @ T_odom_keyframes[source]
        is_apart = apart_m / MOST_APART < geometry.distance(T_target_source) < apart_m * MOST_APART
        if is_apart and geometry.angle(T_target_source) < MOST_TURN_RAD:
            pairs.append((target, source))
    rows = np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_PAIRS)).astype(int)
    return [pairs[row] for row in rows]
