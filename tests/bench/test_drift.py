"""Distortions of a sweep: spread and correlation time as configured, each compared with its exact form."""

import numpy as np
import pytest

from segslam.bench.simulation.sensor import NO_ERROR, SweepError, distorted, sweep_errors
from segslam.bench.simulation.world_settings import SensorConfig
from segslam.core import geometry


def around(num: int = 500) -> tuple[np.ndarray, np.ndarray]:
    """(num, 3) points all round at 3-60 m, and when a sweep that starts behind sees them."""
    rng = np.random.default_rng(0)
    azimuth = rng.uniform(-np.pi, np.pi, num)
    flat = rng.uniform(3.0, 60.0, num)
    points = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), rng.uniform(-2.0, 4.0, num)])
    return points, azimuth / (2 * np.pi)


def test_no_error_changes_nothing():
    points, fraction = around()
    np.testing.assert_array_equal(distorted(points, fraction, NO_ERROR), points)


def test_uncompensated_motion_moves_each_point_by_its_time_in_the_sweep():
    """Against the exact rigid motion: second-order terms, (0.004 / 2)^2 of 60 m, are the tolerance."""
    points, fraction = around()
    motion = geometry.tangent(rotation_rad=[0.002, -0.001, 0.003], translation_m=[0.05, -0.02, 0.01])
    exact = [geometry.apply(geometry.exp(-when * motion), p[None])[0] for p, when in zip(points, fraction, strict=True)]
    np.testing.assert_allclose(distorted(points, fraction, SweepError(motion, 0.0, 0.0)), exact, atol=3e-4)


def test_a_vertical_error_lowers_all_points_by_one_angle():
    points, fraction = around()
    low = distorted(points, fraction, SweepError(NO_ERROR.motion, 0.002, 0.0))
    elevations = [np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (points, low)]
    np.testing.assert_allclose(elevations[0] - elevations[1], 0.002, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(low, axis=1), np.linalg.norm(points, axis=1), rtol=1e-5)


def test_an_azimuth_error_swings_ahead_left_and_behind_right():
    points = np.array([[10.0, 0.0, 1.0], [-10.0, 0.0, 1.0], [0.0, 10.0, 1.0], [0.0, -10.0, 1.0]])
    swung = distorted(points, np.zeros(4), SweepError(NO_ERROR.motion, 0.0, 0.002))
    np.testing.assert_allclose(swung - points, [[0, 0.02, 0], [0, 0.02, 0], [0, 0, 0], [0, 0, 0]], atol=1e-12)


def test_errors_have_the_given_spread_and_correlation_time():
    config = SensorConfig(
        sweep_rotation_sigma_deg=0.5,
        sweep_translation_sigma_m=0.1,
        sweep_correlation_s=1.0,
        axis_wander_sigma_deg=0.2,
        axis_wander_s=2.0,
    )
    errors = list(sweep_errors(0.1 * np.arange(20_000), config=config, rng=np.random.default_rng(0)))
    motion = np.array([error.motion for error in errors])
    wander = np.degrees([[error.vertical_rad, error.azimuth_rad] for error in errors])
    # 1,000 spells of 2 correlation times each: 3 % of the spread is one sigma
    np.testing.assert_allclose(np.degrees(motion[:, :3].std(axis=0)), 0.5, rtol=0.12)
    np.testing.assert_allclose(motion[:, 3:].std(axis=0), 0.1, rtol=0.12)
    np.testing.assert_allclose(wander.std(axis=0), 0.2, rtol=0.15)
    assert np.corrcoef(motion[:-10, 0], motion[10:, 0])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.1)
    assert np.corrcoef(wander[:-20, 1], wander[20:, 1])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.1)


def test_the_first_errors_do_not_depend_on_how_many_follow():
    few, many = (
        list(sweep_errors(0.1 * np.arange(count), config=SensorConfig(), rng=np.random.default_rng(3)))
        for count in (5, 50)
    )
    for a, b in zip(few, many[:5], strict=True):
        np.testing.assert_array_equal(a.motion, b.motion)
        assert (a.vertical_rad, a.azimuth_rad) == (b.vertical_rad, b.azimuth_rad)


def test_all_sigmas_zero_switch_the_errors_off():
    config = SensorConfig(sweep_rotation_sigma_deg=0.0, sweep_translation_sigma_m=0.0, axis_wander_sigma_deg=0.0)
    points, fraction = around()
    for error in sweep_errors(0.1 * np.arange(3), config=config, rng=np.random.default_rng(0)):
        np.testing.assert_array_equal(distorted(points, fraction, error), points)
