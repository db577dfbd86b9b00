"""The compiled registration against KISS-ICP's own, and against plain NumPy."""

import numpy as np
import pytest
from drives import round_drive
from kiss_icp.kiss_icp import KissICP

from segslam import geometry
from segslam.config import OdometryConfig
from segslam.odometry import KissOdometry
from segslam.odometry.kiss import _kiss_config
from segslam.odometry.local_map import LocalMap, nearest
from segslam.odometry.registration import Registration, _normal_equations
from segslam.odometry.sweep import prepare

CONFIG = OdometryConfig(min_range_m=1.0)
BESIDE = np.array([0.1, -0.2, 0.1])


def _align(local: LocalMap, points: np.ndarray, T_odom_guess: np.ndarray, *, most: int = 500) -> np.ndarray:
    registration = Registration(max_iterations=most, convergence=1e-6)
    return registration.align_points_to_map(points, local, T_odom_guess, 2.0, 0.7)


def _map(points: np.ndarray) -> LocalMap:
    local = LocalMap(voxel_m=1.0, max_range_m=100.0, max_points_per_voxel=20)
    local.update(points, np.eye(4))
    return local


def _corner(rng: np.random.Generator, num: int = 3_000) -> np.ndarray:
    """(n, 3) points on three walls at right angles."""
    points = rng.uniform(0.0, 8.0, (num, 3))
    points[np.arange(num), np.arange(num) % 3] = 0.0
    return points


def _step_in_numpy(local: LocalMap, source: np.ndarray, *, bound: float, kernel: float) -> np.ndarray:
    """One Gauss-Newton step [translation; rotation] of KISS-ICP, as its paper writes it."""
    H, g = np.zeros((6, 6)), np.zeros(6)
    for point in source:
        row, place, squared = nearest(local.voxels, 1.0, *point, bound)
        if row >= 0:
            x, y, z = point
            J = np.hstack([np.eye(3), -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])])
            weight = kernel**2 / (kernel + squared) ** 2
            H += weight * J.T @ J
            g += weight * J.T @ (point - local.voxels.points[row, place])
    return np.linalg.solve(H, -g)


def test_the_poses_are_those_of_kiss_icp() -> None:
    """To a micrometre over a drive of 30 scans that turns; every scan rests on the map that those before have left."""
    ours, theirs = KissOdometry(CONFIG), KissICP(_kiss_config(CONFIG))
    for scan in round_drive()[0][:30]:
        found = ours.register(scan)
        theirs.register_frame(prepare(scan, np.eye(4), CONFIG)[0], np.empty(0))
        np.testing.assert_allclose(found.T_odom_lidar, theirs.last_pose, atol=1e-6)
    assert geometry.distance(found.T_odom_lidar) > 20.0


def test_the_normal_equations_are_those_of_plain_numpy() -> None:
    rng = np.random.default_rng(0)
    local, source = _map(_corner(rng)), _corner(rng, 200) + BESIDE
    S = _normal_equations(local.voxels, 1.0, source, 4.0, 0.7)
    H = np.triu(S[:, :6]) + np.triu(S[:, :6], 1).T
    expected = _step_in_numpy(local, source, bound=4.0, kernel=0.7)
    np.testing.assert_allclose(np.linalg.solve(H, -S[:, 6]), expected, rtol=1e-9)


def test_one_step_moves_as_the_exponential_of_the_solution() -> None:
    rng = np.random.default_rng(0)
    local, source = _map(_corner(rng)), _corner(rng, 400) + BESIDE
    step = _step_in_numpy(local, source, bound=4.0, kernel=0.7)
    T_odom_expected = geometry.exp(np.concatenate([step[3:], step[:3]]))
    np.testing.assert_allclose(_align(local, source, np.eye(4), most=1), T_odom_expected, atol=1e-12)


def test_a_moved_corner_finds_back() -> None:
    """The points are those of the map, half a metre apart, so the optimum is exact."""
    lattice = np.stack(np.meshgrid(*3 * [0.25 + 0.5 * np.arange(8)]), axis=-1).reshape(-1, 3)
    points = lattice[(lattice < 0.3).any(axis=1)]
    T_odom_lidar = geometry.exp(np.array([0.01, -0.02, 0.03, 0.05, -0.1, 0.08]))
    seen = geometry.apply(geometry.inverse(T_odom_lidar), points)
    np.testing.assert_allclose(_align(_map(points), seen, np.eye(4)), T_odom_lidar, atol=1e-6)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((4, 3), 50.0)], ids=["no point", "no pair"])
def test_what_says_nothing_moves_nothing(points: np.ndarray) -> None:
    guess = geometry.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(_align(_map(_corner(np.random.default_rng(0))), points, guess), guess, atol=1e-15)


def test_the_guess_stands_where_the_map_is_empty() -> None:
    local = LocalMap(voxel_m=1.0, max_range_m=100.0, max_points_per_voxel=20)
    guess = geometry.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(_align(local, _corner(np.random.default_rng(0)), guess), guess)


def test_a_single_pair_moves_its_point_and_stays_finite() -> None:
    moved = _align(_map(np.array([[2.0, 0.0, 0.0]])), np.array([[2.3, 0.0, 0.0]]), np.eye(4))
    np.testing.assert_allclose(geometry.apply(moved, np.array([[2.3, 0.0, 0.0]])), [[2.0, 0.0, 0.0]], atol=1e-5)
