"""Where beams point, what returns, and each error by itself."""

import numpy as np
import pytest

from segslam.bench.simulation.sensor import NO_ERROR, PATTERNS, Sensor, SweepError, sweep
from segslam.bench.simulation.world import World
from segslam.bench.simulation.world_settings import SensorConfig, WorldConfig
from segslam.core.types import GROUND_LABELS, Label

PERFECT = {
    "range_sigma_m": 0.0,
    "dropout": 0.0,
    "beam_angle_sigma_deg": 0.0,
    "beam_range_sigma_m": 0.0,
    "vertical_angle_error_deg": 0.0,
}
EMPTY = WorldConfig(
    cars=0, trees=0, lamps=0, signs=0, clutter=0, built=0, courts=0, hedged=0, fenced=0, shrubs=0, moving_cars=0
)


def perfect(**changes: float | str) -> SensorConfig:
    return SensorConfig.model_validate(PERFECT | changes)


def straight_drive(num_scans: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """A metre a scan along x on level ground, at 10 Hz."""
    poses = np.tile(np.eye(4), (num_scans, 1, 1))
    poses[:, 0, 3] = np.arange(num_scans)
    return poses, 0.1 * np.arange(num_scans)


@pytest.fixture(scope="module")
def bare_world():
    return World(*straight_drive(), config=EMPTY, seed=0)


@pytest.fixture(scope="module")
def street():
    return World(*straight_drive(), config=WorldConfig(moving_cars=0), seed=0)


def scan_of(world, config: SensorConfig, *, at: int = 15, seed: int = 0, error: SweepError = NO_ERROR):
    T_world_lidar = straight_drive()[0][at]
    sensor = Sensor(config, seed=seed)
    return sweep(world, sensor, T_world_lidar, rng=np.random.default_rng(seed), error=error)


def elevations_deg(points: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


@pytest.mark.parametrize(
    ("name", "beams", "top_deg", "bottom_deg"),
    [("hdl64", 64, 2.0, -24.8), ("os1-64", 64, 22.5, -22.5), ("vlp16", 16, 15.0, -15.0)],
)
def test_beam_directions_are_those_of_the_data_sheet(name, beams, top_deg, bottom_deg):
    sensor = Sensor(perfect(name=name), seed=0)
    found = np.unique(np.round(elevations_deg(sensor.directions), 3))
    assert len(found) == beams
    np.testing.assert_allclose([found[-1], found[0]], [top_deg, bottom_deg], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(sensor.directions, axis=1), 1.0, atol=1e-12)
    assert len(sensor.directions) == beams * PATTERNS[name].num_azimuth


def test_a_perfect_sensor_sees_level_ground_at_its_own_height(bare_world):
    points = scan_of(bare_world, perfect()).points
    near_road = np.abs(points[:, 1]) < 3.0
    # float32 rays, and the road's surface is a spline through the path
    np.testing.assert_allclose(points[near_road, 2], -1.73, atol=2e-3)


def test_range_noise_has_the_given_spread(bare_world):
    truth = scan_of(bare_world, perfect()).points
    noisy = scan_of(bare_world, perfect(range_sigma_m=0.05)).points
    assert len(truth) == len(noisy)
    off = np.linalg.norm(noisy, axis=1) - np.linalg.norm(truth, axis=1)
    assert abs(off.std() - 0.05) < 0.002
    assert abs(off.mean()) < 0.002


def test_a_vertical_angle_error_shows_all_points_too_low(bare_world):
    """The beams look higher than reported: ground is met farther off and reported below where it is."""
    points = scan_of(bare_world, perfect(vertical_angle_error_deg=0.3)).points
    near_road = np.abs(points[:, 1]) < 3.0
    ahead = np.hypot(points[near_road, 0], points[near_road, 1])
    expected = -1.73 - np.tan(np.radians(0.3)) * ahead  # first order in the angle
    np.testing.assert_allclose(points[near_road, 2], expected, rtol=0.02)


def test_beam_errors_last_from_sweep_to_sweep_and_change_with_the_seed(bare_world):
    config = perfect(beam_range_sigma_m=0.05)
    truth = np.linalg.norm(scan_of(bare_world, perfect()).points, axis=1)
    first, again = (np.linalg.norm(scan_of(bare_world, config, at=at).points, axis=1) - truth for at in (15, 15))
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(np.round(first, 6))) <= 64
    errors = [Sensor(config, seed=seed).range_error_m for seed in (0, 1)]
    assert not np.array_equal(*errors)


def test_dropout_loses_the_given_share(street):
    kept = len(scan_of(street, perfect(dropout=0.3)).points) / len(scan_of(street, perfect()).points)
    assert abs(kept - 0.7) < 0.01  # some 120,000 draws


def test_grazing_and_far_ground_is_lost_before_near_ground(bare_world):
    sensor = Sensor(perfect(), seed=0)
    ranges = np.linalg.norm(scan_of(bare_world, perfect()).points, axis=1)
    all_ranges = bare_world.cast(straight_drive()[0][15], sensor.directions).range_m
    near, far = ((all_ranges > low) & (all_ranges < high) for low, high in ((3, 20), (60, 79)))
    assert ((ranges > 3) & (ranges < 20)).sum() == pytest.approx(near.sum(), rel=0.01)
    assert ((ranges > 60) & (ranges < 79)).sum() < 0.5 * far.sum()


def test_rows_of_a_sweep_belong_together(street):
    one = scan_of(street, SensorConfig())
    assert len(one.points) == len(one.labels) == len(one.instances) == len(one.intensity)
    assert 90_000 < len(one.points) < 133_312
    assert one.intensity.min() >= 0.0
    assert one.intensity.max() < 1.0
    cars = one.labels == Label.CAR
    assert cars.any()
    assert (one.instances[cars] > 0).all()
    assert (one.instances[np.isin(one.labels, GROUND_LABELS)] == 0).all()
