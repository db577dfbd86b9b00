"""What registrations claim of their error, held against the truth; the calibration itself is on other drives."""

from functools import cache
from itertools import product

import numpy as np
import pytest
from drives import NUM_SCANS, RADIUS_M, STEP_M

from segslam import geometry
from segslam.alignment import PreparedScan, align, prepare_scan, register
from segslam.config import Config
from segslam.simulation import SensorConfig, WorldConfig, build_world, make_sensor, sweep, sweep_errors
from segslam.types import Alignment, Registration

CONFIG = Config()
CHI2_95 = 12.592
"""0.95 quantile of chi-square with 6 degrees of freedom."""
FIRST_ROUND, SECOND_ROUND = range(0, 18, 3), range(51, 69, 3)


@cache
def _pairs() -> list[tuple[Alignment, np.ndarray]]:
    """36 pairs of scans of an HDL-64E with all its errors, 0-20 m apart, with the true pose of each."""
    along = STEP_M * np.arange(NUM_SCANS) / RADIUS_M
    T_world_lidar = np.stack(
        [geometry.transform(geometry.yaw(a), [RADIUS_M * np.sin(a), -RADIUS_M * np.cos(a), 1.73]) for a in along]
    )
    time_s = 0.3 * np.arange(NUM_SCANS)
    world = build_world(T_world_lidar, time_s, config=WorldConfig(), seed=4)
    sensor = make_sensor(SensorConfig(), seed=4)
    errors = list(sweep_errors(time_s, config=SensorConfig(), rng=np.random.default_rng(4)))

    def prepared(index: int) -> PreparedScan:
        swept = sweep(
            world,
            sensor,
            T_world_lidar[index],
            rng=np.random.default_rng([4, index]),
            time_s=float(time_s[index]),
            error=errors[index],
        )
        return prepare_scan(swept.points, swept.labels, config=CONFIG)

    scans = {index: prepared(index) for index in (*FIRST_ROUND, *SECOND_ROUND)}
    found = []
    for target, source in product(FIRST_ROUND, SECOND_ROUND):
        alignment = align(scans[source], scans[target], config=CONFIG)
        assert isinstance(alignment, Alignment), f"{source} -> {target}: {alignment}"
        found.append((alignment, geometry.inverse(T_world_lidar[target]) @ T_world_lidar[source]))
    return found


def _squared(registration: Registration, T_true: np.ndarray) -> float:
    xi = geometry.log(geometry.inverse(T_true) @ registration.T_target_source)
    return float(xi @ registration.information @ xi)


@pytest.mark.parametrize("stage", ["coarse", "fine"])
def test_squared_errors_are_what_the_information_claims(stage: str) -> None:
    """They are 6 in the mean if it is true of this drive as of those that it was calibrated on.

    36 pairs of 12 scans, whose own errors change slowly, are some 4 independent draws: three standard deviations of
    their mean, 3 sqrt(12 / 4), are 5 above 6, and as a factor below it. The Hessian alone would give hundreds.
    """
    squared = np.array([_squared(getattr(alignment, stage), T_true) for alignment, T_true in _pairs()])
    assert 1.0 < squared.mean() < 11.0
    assert (squared < CHI2_95).mean() > 0.8


@pytest.mark.data
def test_triangles_of_real_pairs_close_within_what_is_claimed(real_pairs) -> None:
    """The three poses share scans, and with them part of their errors: they close better than the claims add up to."""
    found = {
        (pair.source, pair.target): register(real_pairs.points(pair.source), real_pairs.points(pair.target))
        for pair in real_pairs.pairs
        if {pair.source, pair.target} <= {0, 10, 20, 30, 4413}
    }
    for a, b, c in ((0, 20, 30), (0, 20, 4413), (0, 30, 4413), (20, 30, 4413), (0, 10, 4413)):
        T_b_a, T_c_b, T_c_a = (found[pair].fine.T_target_source for pair in ((a, b), (b, c), (a, c)))
        xi = geometry.log(geometry.inverse(T_c_a) @ T_c_b @ T_b_a)
        covariance = sum(
            _seen_from(T_here_a, np.linalg.inv(found[pair].fine.information))
            for pair, T_here_a in (((a, b), np.eye(4)), ((b, c), T_b_a), ((a, c), np.eye(4)))
        )
        assert xi @ np.linalg.solve(covariance, xi) < CHI2_95, f"{a} -> {b} -> {c}"


def _seen_from(T_here_there: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """The covariance of a tangent at `here`, as that of the tangent at `there` which has the same effect."""
    inverse = geometry.inverse(T_here_there)
    R, (x, y, z) = inverse[:3, :3], inverse[:3, 3]
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = R
    adjoint[3:, :3] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ R
    return adjoint @ covariance @ adjoint.T
