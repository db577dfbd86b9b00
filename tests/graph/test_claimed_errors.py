"""What registrations and odometry claim of their error, held against the truth; calibrated on other drives."""

from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from helpers.drives import NUM_SCANS, RADIUS_M, STEP_M, simulate_drive

from segslam.bench.simulation.sensor import Sensor, sweep, sweep_errors
from segslam.bench.simulation.world import World
from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig, WorldConfig
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import Alignment, Information, Transform
from segslam.graph.noise import closure_information, odometry_information
from segslam.keyframes import KeyframeSelector
from segslam.odometry.kiss import KissOdometry
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.verification import register, register_prepared

pytestmark = pytest.mark.long
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
    world = World(T_world_lidar, time_s, config=WorldConfig(), seed=4)
    sensor = Sensor(SensorConfig(), seed=4)
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
        alignment = register_prepared(scans[source], scans[target], config=CONFIG)
        assert isinstance(alignment, Alignment), f"{source} -> {target}: {alignment}"
        found.append((alignment, geometry.inverse(T_world_lidar[target]) @ T_world_lidar[source]))
    return found


def _squared(T_found: Transform, information: Information, T_true: Transform) -> float:
    xi = geometry.log(geometry.inverse(T_true) @ T_found)
    return float(xi @ information @ xi)


@pytest.mark.parametrize("stage", ["coarse", "fine"])
def test_squared_errors_are_what_the_information_claims(stage: str) -> None:
    """They are 6 in the mean if it is true of this drive as of those that it was calibrated on.

    36 pairs of 12 scans, whose own errors change slowly, are some 4 independent draws: three standard deviations of
    their mean, 3 sqrt(12 / 4), are 5 above 6, and as a factor below it. The Hessian alone would give hundreds.
    """
    found = [(getattr(alignment, stage), T_true) for alignment, T_true in _pairs()]
    squared = np.array([_squared(one.T_target_source, one.information, T_true) for one, T_true in found])
    assert 1.0 < squared.mean() < 11.0
    assert (squared < CHI2_95).mean() > 0.8


def test_mean_error_of_closures_of_one_place_matches_their_information() -> None:
    """The graph adds up the six closures of each target as if they were independent; they share that scan, and the rays
    that the sensor bends. Bounds as above: 36 pairs are no more draws for being grouped. Single ones err less.
    """
    means, singles = [], []
    for start in range(0, 36, len(SECOND_ROUND)):
        pairs = _pairs()[start : start + len(SECOND_ROUND)]
        informations = [closure_information(alignment.fine.information) for alignment, _ in pairs]
        errors = [geometry.log(geometry.inverse(T) @ alignment.fine.T_target_source) for alignment, T in pairs]
        weighed = sum(information @ xi for information, xi in zip(informations, errors, strict=True))
        means.append(weighed @ np.linalg.solve(sum(informations), weighed))
        singles += [xi @ information @ xi for information, xi in zip(informations, errors, strict=True)]
    assert 1.0 < np.mean(means) < 11.0
    assert max(means) < CHI2_95
    assert max(singles) < CHI2_95


@cache
def _odometry() -> tuple[np.ndarray, np.ndarray]:
    """Keyframes of KISS-ICP on a drive from rest along a winding street, and their true poses, from the second on.

    The first motion is left out: KISS-ICP has nothing yet to predict it from, and errs by 0.2 m.
    """
    way_m = np.cumsum(np.minimum(0.1 * np.arange(70), 1.1))
    heading = 0.5 * np.sin(way_m / 25.0)
    steps = np.diff(way_m, prepend=0.0)[:, None] * np.column_stack([np.cos(heading), np.sin(heading), 0.0 * heading])
    positions = np.cumsum(steps, axis=0) + np.array([0.0, 0.0, 1.73])
    truth = np.stack([geometry.transform(geometry.yaw(a), at) for a, at in zip(heading, positions, strict=True)])
    odometry, selector = KissOdometry(CONFIG.odometry), KeyframeSelector(CONFIG.keyframes)
    scans = simulate_drive(truth, 0.1 * np.arange(len(truth)), seed=6, config=SimulationConfig())
    poses = np.stack([odometry.register(scan).T_odom_lidar for scan in scans])
    rows = [row for row, T_odom_lidar in enumerate(poses) if selector.update(T_odom_lidar)][1:]
    return poses[rows], truth[rows]


@pytest.mark.slow
@pytest.mark.parametrize("length", [1, 8])
def test_odometry_errors_match_the_information_of_the_edges(length: int) -> None:
    """Single edges, and chains of 8 (17 m). Identities would claim a ten-thousandth of it, sigmas thrice as large nine
    times as much.

    Some 30 edges whose errors change slowly are some 10 independent draws: three standard deviations of their mean,
    3 sqrt(12 / 10), are 3.3. Chains may err by as little as a third of the variance: parts of the errors do not add up.
    """
    poses, truth = _odometry()
    motions = [geometry.inverse(a) @ b for a, b in pairwise(poses)]
    covariances = [np.linalg.inv(odometry_information(0.0, T_a_b, CONFIG.graph)) for T_a_b in motions]
    squared = []
    for start in range(len(motions) - length + 1):
        end = start + length
        covariance = sum(
            _seen_from(geometry.inverse(poses[end]) @ poses[k + 1], covariances[k]) for k in range(start, end)
        )
        T_true = geometry.inverse(truth[start]) @ truth[end]
        squared.append(_squared(geometry.inverse(poses[start]) @ poses[end], np.linalg.inv(covariance), T_true))
    least = 2.7 if length == 1 else 1.5
    assert least < np.mean(squared) < 9.3
    assert np.mean(np.array(squared) < CHI2_95) > 0.8


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
