"""Model of a LiDAR: beam directions, returned points, and sensor errors; its sweeps along a drive.

A sweep depends only on the seed and its own number. Slowly varying errors cause odometry drift; each is an
Ornstein-Uhlenbeck process. Uncompensated motion within a sweep blurs the scan. A spinning head whose axis and encoder
errors vary distorts the points ahead and behind in the same way: every metre of travel then adds a rotation error,
vertical and horizontal.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from segslam.bench.simulation.mesh import Instances
from segslam.bench.simulation.world import Hits, World
from segslam.bench.simulation.world_settings import SensorConfig, SensorName
from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Label, Labels, Points, Tangent, Transform, Vector


@dataclass(frozen=True, slots=True, eq=False)
class SweepError:
    """Errors of one sweep; all are small."""

    motion: Tangent
    """Uncompensated motion during the whole sweep."""
    vertical_rad: float
    """Angle by which every point appears too low."""
    azimuth_rad: float
    """Azimuth error: points ahead appear too far left and points behind too far right; points abeam do not move."""


NO_ERROR = SweepError(geometry.tangent(rotation_rad=0.0, translation_m=0.0), 0.0, 0.0)


def sweep_errors(time_s: Vector, *, config: SensorConfig, rng: np.random.Generator) -> Iterator[SweepError]:
    """The errors of the sweeps at the times (n,), ascending.

    The errors of a sweep do not depend on the number of sweeps after it.
    """
    motion_rng, wander_rng = rng.spawn(2)
    still = geometry.tangent(
        rotation_rad=np.radians(config.sweep_rotation_sigma_deg), translation_m=config.sweep_translation_sigma_m
    )
    motions = still * _slow_noise(time_s, 6, config.sweep_correlation_s, motion_rng)
    wander = np.radians(config.axis_wander_sigma_deg) * _slow_noise(time_s, 2, config.axis_wander_s, wander_rng)
    for motion, (vertical, azimuth) in zip(motions, wander, strict=True):
        yield SweepError(motion, float(vertical), float(azimuth))


def _slow_noise(time_s: Vector, count: int, correlation_s: float, rng: np.random.Generator) -> np.ndarray:
    """(n, count) samples of Ornstein-Uhlenbeck processes of unit variance."""
    kept = np.exp(-np.diff(time_s, prepend=time_s[:1]) / correlation_s)
    noise = rng.normal(size=(len(time_s), count))
    for row in range(1, len(noise)):
        noise[row] = kept[row] * noise[row - 1] + np.sqrt(1.0 - kept[row] ** 2) * noise[row]
    return noise


def distorted(points: Points, sweep_fraction: Vector, error: SweepError) -> Points:
    """Points of the LiDAR frame displaced by the errors of a sweep, to first order in the errors.

    `sweep_fraction` (n,): time of each point within the sweep, from -0.5 to 0.5. The sensor's pose refers to time 0.
    """
    a, b, c = error.motion[:3]
    turned = np.einsum("ij,kj->ik", points, np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]))
    x, y, z = points.T
    flat = np.maximum(np.hypot(x, y), 1e-9)
    lowered = error.vertical_rad * np.column_stack([z * x / flat, z * y / flat, -flat])
    swung = error.azimuth_rad * (x / flat)[:, None] * np.column_stack([-y, x, np.zeros_like(z)])
    return points - sweep_fraction[:, None] * (turned + error.motion[3:]) + lowered + swung


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """Beam directions of one sweep, and the maximum range."""

    elevations_deg: Vector
    num_azimuth: int
    max_range_m: float
    min_range_m: float


PATTERNS: dict[SensorName, Pattern] = {
    "hdl64": Pattern(np.concatenate([np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.8, 32)]), 2083, 80.0, 2.0),
    "os1-64": Pattern(np.linspace(22.5, -22.5, 64), 1024, 120.0, 0.8),
    "vlp16": Pattern(np.linspace(15.0, -15.0, 16), 1800, 100.0, 0.9),
}
# Mean and standard deviation of the intensity by class, from real HDL-64E scans of KITTI 00 with their true labels.
INTENSITY = {
    Label.UNLABELLED: (0.28, 0.16), Label.CAR: (0.15, 0.18), Label.TRUCK: (0.2, 0.18), Label.ROAD: (0.21, 0.11),
    Label.PARKING: (0.30, 0.09), Label.SIDEWALK: (0.30, 0.08), Label.BUILDING: (0.43, 0.15), Label.FENCE: (0.29, 0.12),
    Label.VEGETATION: (0.33, 0.13), Label.TRUNK: (0.31, 0.14), Label.TERRAIN: (0.31, 0.12), Label.POLE: (0.20, 0.17),
    Label.TRAFFIC_SIGN: (0.6, 0.25), Label.MOVING_CAR: (0.15, 0.18),
}  # fmt: skip
MEAN_INTENSITY, SPREAD_INTENSITY = np.array(
    [INTENSITY.get(label, INTENSITY[Label.UNLABELLED]) for label in Label], dtype=np.float32
).T
SIGNAL = 35.0  # chosen: a road (reflectivity 0.2, normal incidence) is visible up to 50 m, as in real scans
GLASS_PASSES = 0.6  # chosen: share of the rays that a car window does not return


class Sensor:
    """One sensor with fixed errors, drawn with the seed. Its n rays are ordered by beam, the top beam first."""

    def __init__(self, config: SensorConfig, *, seed: int) -> None:
        self.config = config
        self.pattern = pattern = PATTERNS[config.name]
        beams = len(pattern.elevations_deg)
        rng = np.random.default_rng([seed, 2])
        angle_error = config.vertical_angle_error_deg + rng.normal(scale=config.beam_angle_sigma_deg, size=beams)
        range_error = rng.normal(scale=config.beam_range_sigma_m, size=beams)
        azimuth = np.arange(pattern.num_azimuth) * (2 * np.pi / pattern.num_azimuth)
        self.directions = _directions(pattern.elevations_deg + angle_error, azimuth)
        """(n, 3) unit vectors of the true beam directions in the LiDAR frame."""
        self.reported = _directions(pattern.elevations_deg, azimuth)
        """(n, 3) reported beam directions."""
        self.range_error_m = np.repeat(range_error, pattern.num_azimuth)
        self.sweep_fraction = np.tile((azimuth / (2 * np.pi) + 0.5) % 1.0 - 0.5, beams)
        """(n,) time of each ray within the sweep: -0.5 at the start, behind the car, to 0.5 at the end."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """The points that one sweep returned, one row each. `points`: LiDAR frame, float64."""

    points: Points
    intensity: Vector
    labels: Labels
    instances: Instances


def _directions(elevations_deg: Vector, azimuth_rad: Vector) -> Points:
    elevation = np.radians(elevations_deg)[:, None]
    flat, up = np.cos(elevation), np.sin(elevation)
    rays = np.stack(np.broadcast_arrays(flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), up), axis=-1)
    return rays.reshape(-1, 3)


def sweep(
    world: World,
    sensor: Sensor,
    T_world_lidar: Transform,
    *,
    rng: np.random.Generator,
    time_s: float = 0.0,
    error: SweepError = NO_ERROR,
) -> Sweep:
    """One sweep from one pose, with the sensor's fixed errors and the errors of this sweep."""
    hits = world.cast(T_world_lidar, sensor.directions, time_s=time_s)
    rows = np.flatnonzero(_returns(hits, sensor, rng))
    labels = hits.labels[rows]
    noise = rng.normal(scale=sensor.config.range_sigma_m, size=len(rows)) if sensor.config.range_sigma_m else 0.0
    reported = sensor.reported[rows] * (hits.range_m[rows] + sensor.range_error_m[rows] + noise)[:, None]
    points = distorted(reported, sensor.sweep_fraction[rows], error)
    return Sweep(points, _intensity(labels, rng), labels, hits.instances[rows])


def _returns(hits: Hits, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: whether enough light returns; more for bright and near surfaces and for small angles of incidence."""
    pattern = sensor.pattern
    seen = (hits.range_m > pattern.min_range_m) & (hits.range_m < pattern.max_range_m)
    with np.errstate(divide="ignore", over="ignore"):
        light = SIGNAL * MEAN_INTENSITY[hits.labels] * hits.cos_incidence * (pattern.max_range_m / hits.range_m) ** 2
    share = (1.0 - np.exp(-light)) * (1.0 - sensor.config.dropout) * np.where(hits.glass, 1.0 - GLASS_PASSES, 1.0)
    return seen & (rng.random(len(share), dtype=np.float32) < share)


def _intensity(labels: Labels, rng: np.random.Generator) -> Vector:
    """Intensities by class, 0 to 0.99 in steps of 0.01."""
    drawn = MEAN_INTENSITY[labels] + SPREAD_INTENSITY[labels] * rng.standard_normal(len(labels), dtype=np.float32)
    return np.round(np.clip(drawn, 0.0, 0.99), 2)


def drive_sweeps(
    world: World,
    T_world_lidar: Poses,
    time_s: Vector,
    *,
    config: SensorConfig,
    seed: int,
    only: Collection[int] | None = None,
) -> Iterator[Sweep]:
    """The sweeps of a drive through a world, in order; only the numbers in `only`, if given.

    The sensor is the same on each simulated day; its noise differs.
    """
    sensor = Sensor(config, seed=seed)
    days = [world.day] if world.day else []
    errors = sweep_errors(time_s, config=config, rng=np.random.default_rng([seed, 3, *days]))
    for index, (T_world_now, now, error) in enumerate(zip(T_world_lidar, time_s, errors, strict=True)):
        if only is not None and index not in only:
            continue
        rng = np.random.default_rng([seed, 4, index, *days])
        yield sweep(world, sensor, T_world_now, rng=rng, time_s=float(now), error=error)
