"""Poses from matched points with outliers: known answers, symmetries, degenerate cases, the authors' poses."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.types import Points, Registration, Rejected, RejectReason, Transform
from segslam.registration.segregator.pose_solver import (
    _axis_sigma,
    point_information,
    rotation_between,
    solve_level,
    solve_pose,
    vote,
    weighted_pose,
    yaw_between,
)

SOLVERS = ["joint", "decoupled"]
BOUND_M = 0.2


def solve(source: Points, target: Points, config: SegregatorConfig | None = None) -> Registration | Rejected:
    found = solve_pose(source, target, bound_m=BOUND_M, config=config or SegregatorConfig())
    return found if isinstance(found, Rejected) else found[1]


def test_residuals_of_a_fitted_pose_have_six_degrees_of_freedom_less() -> None:
    assert _axis_sigma(np.full(4, 0.06), 0.2) == pytest.approx(math.sqrt(0.24 / 6.0))
    assert _axis_sigma(np.full(4, 1e-6), 0.3) == pytest.approx(0.1)


def random_pose(rng: np.random.Generator, rotation: str = "full") -> Transform:
    R = ScipyRotation.random(random_state=rng).as_matrix() if rotation == "full" else geometry.yaw(rng.uniform(-3, 3))
    return geometry.transform(R, rng.uniform(-30, 30, 3))


def matched(T_target_source: Transform, rng: np.random.Generator, *, inliers: int, outliers: int, noise_m: float):
    source = rng.uniform(-40, 40, size=(inliers + outliers, 3))
    target = geometry.apply(T_target_source, source) + rng.normal(scale=noise_m, size=source.shape)
    target[inliers:] += rng.choice([-1, 1], size=(outliers, 3)) * rng.uniform(1, 30, size=(outliers, 3))
    return source, target


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("rotation", ["full", "yaw"])
@pytest.mark.parametrize("seed", range(3))
def test_exact_matches_give_the_exact_pose(solver: str, rotation: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_true = random_pose(rng, rotation)
    source, target = matched(T_true, rng, inliers=8, outliers=0, noise_m=0.0)
    fit = solve(source, target, config=SegregatorConfig(solver=solver, rotation=rotation))
    assert np.allclose(fit.T_target_source, T_true, atol=1e-9)
    assert fit.num_inliers == 8
    assert fit.rms_m < 1e-9


@pytest.mark.parametrize("rotation", ["full", "yaw"])
@pytest.mark.parametrize("seed", range(10))
def test_a_third_of_outliers_does_not_move_the_joint_pose(rotation: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_true = random_pose(rng, rotation)
    source, target = matched(T_true, rng, inliers=20, outliers=10, noise_m=0.03)
    fit = solve(source, target, config=SegregatorConfig(rotation=rotation))
    error = fit.T_target_source @ geometry.inverse(T_true)
    centre = source[:20].mean(axis=0)
    # 0.03 m / sqrt(20) in each axis at the inliers' centre, and three times that for chance.
    assert np.linalg.norm(target[:20].mean(axis=0) - geometry.apply(fit.T_target_source, centre[None])[0]) < 0.03
    assert np.degrees(geometry.angle(error)) < 0.1
    assert fit.num_inliers == 20


def test_joint_pose_without_outliers_is_the_least_squares_pose() -> None:
    rng = np.random.default_rng(0)
    source, target = matched(random_pose(rng), rng, inliers=15, outliers=0, noise_m=0.02)
    rotation, _ = ScipyRotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    fit = solve(source, target)
    assert np.allclose(fit.T_target_source[:3, :3], rotation.as_matrix(), atol=1e-9)


def test_joint_pose_has_no_greater_truncated_cost_than_nearby_poses() -> None:
    rng = np.random.default_rng(1)
    source, target = matched(random_pose(rng), rng, inliers=12, outliers=6, noise_m=0.05)
    config = SegregatorConfig()
    fit = solve(source, target, config=config)

    def cost(T_target_source: Transform) -> float:
        squared = np.sum((target - geometry.apply(T_target_source, source)) ** 2, axis=1)
        return float(np.minimum(squared, BOUND_M**2).sum())

    for _ in range(200):
        step = geometry.tangent(
            rotation_rad=rng.normal(scale=1e-3, size=3), translation_m=rng.normal(scale=0.02, size=3)
        )
        assert cost(fit.T_target_source) <= cost(fit.T_target_source @ geometry.exp(step))


@pytest.mark.slow
@given(seed=st.integers(0, 2**32))
def test_swapping_the_two_sides_inverts_the_joint_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target = matched(random_pose(rng), rng, inliers=12, outliers=4, noise_m=0.02)
    forth = solve(source, target)
    back = solve(target, source)
    assert np.allclose(forth.T_target_source @ back.T_target_source, np.eye(4), atol=1e-6)


def test_weights_of_zero_take_rows_out_of_the_weighted_pose() -> None:
    rng = np.random.default_rng(2)
    T_true = random_pose(rng)
    source, target = matched(T_true, rng, inliers=6, outliers=6, noise_m=0.0)
    T_found = weighted_pose(source, target, np.repeat([2.0, 0.0], 6), rotation_between)
    assert np.allclose(T_found, T_true, atol=1e-9)


def test_yaw_alone_is_the_best_of_all_turns_about_z() -> None:
    rng = np.random.default_rng(3)
    source, target, weights = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), rng.uniform(size=9)
    best = np.sum(weights * np.sum((target - source @ yaw_between(source, target, weights).T) ** 2, axis=1))
    for angle in np.linspace(-math.pi, math.pi, 721):
        assert best <= np.sum(weights * np.sum((target - source @ geometry.yaw(angle).T) ** 2, axis=1)) + 1e-12


def test_rotation_of_a_mirrored_cloud_is_no_mirror() -> None:
    source = np.random.default_rng(4).normal(size=(10, 3))
    assert np.linalg.det(rotation_between(source, source * [1, 1, -1], np.ones(10))) == pytest.approx(1.0)


def test_vote_is_the_mean_of_the_larger_group() -> None:
    assert vote(np.array([1.0, 1.1, 1.2, 7.0, 7.05]), bound_m=0.2) == pytest.approx(1.1)


def test_vote_of_one_value_is_that_value() -> None:
    assert vote(np.array([3.5]), bound_m=0.2) == pytest.approx(3.5)


def test_level_pose_turns_up_into_up_and_needs_no_more_than_places_seen_from_above() -> None:
    rng = np.random.default_rng(5)
    T_true = random_pose(rng)
    source = rng.uniform(-30, 30, size=(8, 3)) * [1.0, 0.0, 0.0]
    up = np.array([0.0, 0.0, 1.0])
    T_found = solve_level(source, geometry.apply(T_true, source), up, T_true[:3, 2], bound_m=BOUND_M)
    assert np.allclose(T_found, T_true, atol=1e-9)


@pytest.mark.parametrize("up", [[0, 0, 1.0], [0, 0, -1.0], [0.6, 0, 0.8], [0, -1.0, 0]])
def test_level_pose_takes_any_direction_for_up(up: list[float]) -> None:
    points = np.random.default_rng(8).uniform(-30, 30, size=(8, 3))
    T_found = solve_level(points, points, np.array(up), np.array(up), bound_m=BOUND_M)
    assert np.allclose(T_found, np.eye(4), atol=1e-9)


def test_level_pose_takes_its_height_from_the_inliers_in_the_middle() -> None:
    source = np.random.default_rng(6).uniform(-30, 30, size=(9, 3))
    target = source + np.array([0.0, 0.0, 2.0])
    target[:3, 2] += [5.0, -4.0, 0.7]
    up = np.array([0.0, 0.0, 1.0])
    T_found = solve_level(source, target, up, up, bound_m=BOUND_M)
    assert np.allclose(T_found, geometry.transform(np.eye(3), [0.0, 0.0, 2.0]), atol=1e-9)


def test_level_pose_of_one_place_is_degenerate() -> None:
    tower = np.array([[1.0, 2.0, z] for z in (0.0, 3.0, 7.0)])
    up = np.array([0.0, 0.0, 1.0])
    outcome = solve_level(tower, tower, up, up, bound_m=BOUND_M)
    assert outcome.reason is RejectReason.DEGENERATE


@pytest.mark.parametrize("up", [[0, 0, 1.0], [0.6, 0, 0.8], [0, -1.0, 0]])
def test_information_of_points_is_that_of_their_jacobians(up: list[float]) -> None:
    """By numerical differentiation of T exp(xi) a."""
    rng = np.random.default_rng(7)
    source, T_any, step = rng.normal(size=(4, 3)) + up, random_pose(rng), 1e-6
    columns = []
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = step
        shift = geometry.apply(T_any @ geometry.exp(xi), source) - geometry.apply(T_any @ geometry.exp(-xi), source)
        columns.append(shift.ravel() / (2 * step))
    J = np.stack(columns, axis=1)
    assert np.allclose(point_information(source, sigma_m=0.5), J.T @ J / 0.25, atol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_points_are_degenerate(solver: str, count: int) -> None:
    points = np.random.default_rng(0).normal(scale=10, size=(count, 3))
    assert solve(points, points, config=SegregatorConfig(solver=solver)).reason is RejectReason.DEGENERATE


def test_two_points_fix_a_yaw_and_one_or_two_above_each_other_do_not() -> None:
    config = SegregatorConfig(rotation="yaw")
    pair = np.array([[0.0, 0, 0], [5.0, 0, 0]])
    fit = solve(pair, geometry.apply(geometry.transform(geometry.yaw(1.0), [1.0, 2, 3]), pair), config=config)
    assert isinstance(fit, Registration)
    above = np.array([[0.0, 0, 0], [0.0, 0, 5]])
    assert solve(pair[:1], pair[:1], config=config).reason is RejectReason.DEGENERATE
    assert solve(above, above, config=config).reason is RejectReason.DEGENERATE


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("spread", [[1.0, 0, 0], [0, 0, 1.0], [0, 0, 0]])
def test_points_on_a_line_or_in_a_spot_are_degenerate(solver: str, spread: list[float]) -> None:
    points = np.random.default_rng(0).normal(scale=20, size=(10, 3)) * spread
    assert solve(points, points, config=SegregatorConfig(solver=solver)).reason is RejectReason.DEGENERATE


def test_inconsistent_rows_are_degenerate() -> None:
    source, target = np.random.default_rng(0).uniform(-50, 50, size=(2, 4, 3))
    assert solve(source, target).reason is RejectReason.DEGENERATE


@pytest.mark.data
@pytest.mark.parametrize("pair", ["000000_000030", "000000_004413"])
def test_decoupled_pose_of_a_real_clique_is_that_of_the_authors_program(data_dir: Path, pair: str) -> None:
    golden = np.load(data_dir / "golden" / f"{pair}_fixed_trunkDCVC.npz")
    clique = golden["clique"]
    config = SegregatorConfig(solver="decoupled")
    fit = solve(golden["corr_src"][clique], golden["corr_tgt"][clique], config=config)
    error = fit.T_target_source @ geometry.inverse(golden["T"])
    assert geometry.distance(error) < 0.01
    assert np.degrees(geometry.angle(error)) < 0.05
