"""A bend that closures cannot see, scans that can, and a decision by stretches of the drive held out of the fit."""

import itertools

import numpy as np
import pytest

from segslam import geometry
from segslam.config import GraphConfig
from segslam.pose_graph import PoseGraph, judge
from segslam.pose_graph.drift import (
    BEND_M,
    LEAST_SAMPLES,
    MARGIN,
    STRAIGHTENED_WORTH,
    STRETCH,
    fitted,
    straightened,
)
from segslam.pose_graph.edges import Edge
from segslam.types import Alignment, AngleSamples, LoopClosure, Registration

STEP_M = 2.0
TRAVEL_M = np.arange(10.0, 1210.0, 10.0)
SAMPLE_SIGMA = np.radians(0.06)
EXCESS_SIGMA = np.radians(0.004)
"""Of one pair of scans, rad and rad/m: as on simulated 06."""


def bent(T_world: np.ndarray, down_rad_per_m: float, left_rad_per_m: float = 0.0) -> np.ndarray:
    """Odometry that turns down and left (half before and half after each motion) with every metre."""
    rotation_rad = np.array([0.0, down_rad_per_m, left_rad_per_m]) * STEP_M / 2
    half = geometry.exp(geometry.tangent(rotation_rad=rotation_rad, translation_m=0.0))
    poses = [T_world[0]]
    for T_a, T_b in itertools.pairwise(T_world):
        poses.append(poses[-1] @ half @ geometry.inverse(T_a) @ T_b @ half)
    return np.array(poses)


def block(side_m: float, *, rounds: float) -> np.ndarray:
    """(n, 4, 4) poses around a square block on flat ground, corners cut by one pose that turns."""
    num_side = int(side_m / STEP_M)
    T = np.eye(4)
    poses = [T]
    for i in range(1, int(4 * num_side * rounds)):
        turn = geometry.yaw(np.pi / 2 if i % num_side == 0 else 0.0)
        T = T @ geometry.transform(turn, [STEP_M, 0.0, 0.0])
        poses.append(T)
    return np.array(poses)


def graph_of(T_odom: np.ndarray, config: GraphConfig | None = None) -> PoseGraph:
    graph = PoseGraph(config or GraphConfig())
    for i, T_odom_keyframe in enumerate(T_odom):
        graph.add_keyframe(i, T_odom_keyframe, STEP_M * i)
    return graph


def closure(T_world: np.ndarray, source: int, target: int) -> LoopClosure:
    T_target_source = geometry.inverse(T_world[target]) @ T_world[source]
    registration = Registration(T_target_source, 0, 0, 0.0, 1e4 * np.eye(6))
    alignment = Alignment(registration, registration, 1.0, 0.0, 0.0)
    return LoopClosure(source, target, T_target_source, registration.information, alignment)


def samples(
    vertical_deg: float | np.ndarray = 0.0,
    azimuth_deg: float | np.ndarray = 0.0,
    *,
    followed: float = 1.0,
    seed: int = 0,
    num: int = len(TRAVEL_M),
) -> AngleSamples:
    """Pairs of scans that err as real ones do, on a drive whose odometry follows the angles so far."""
    rng = np.random.default_rng(seed)
    angle = np.radians(np.broadcast_to(np.column_stack(np.broadcast_arrays(vertical_deg, azimuth_deg)), (num, 2)))
    return AngleSamples(
        TRAVEL_M[:num],
        angle + SAMPLE_SIGMA * rng.normal(size=(num, 2)),
        followed * angle / BEND_M + EXCESS_SIGMA * rng.normal(size=(num, 2)),
    )


def wander(sigma_deg: float, seed: int) -> np.ndarray:
    """(n,) an angle that changes along the drive as it is taken to."""
    rng = np.random.default_rng([seed, 1])
    covariance = np.exp(-np.abs(TRAVEL_M[:, None] - TRAVEL_M) / 150.0)
    return sigma_deg * np.linalg.cholesky(covariance) @ rng.normal(size=len(TRAVEL_M))


def test_loops_close_as_well_on_a_bent_world_as_on_a_flat_one() -> None:
    """Why closures are not asked: what lifts this drive by metres opens its loop by centimetres."""
    truth = block(120.0, rounds=1.5)
    T_odom = bent(truth, np.radians(0.25) / BEND_M[0])
    source, target = 260, 20
    lifted_m = np.abs(T_odom[:, 2, 3]).max()
    true, off = (closure(T_world, source, target).T_target_source for T_world in (truth, T_odom))
    opened = geometry.inverse(true) @ off
    assert lifted_m > 1.0
    assert geometry.distance(opened) < 0.06, "as much as closures err"
    assert geometry.angle(opened) < np.radians(0.02), "of 3 degrees pitched in all"


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("angles_deg", [(-0.4, 0.0), (-0.1, 0.0), (0.13, 0.0), (0.0, -0.15), (0.2, 0.3)])
def test_angles_that_bend_the_odometry_are_believed(angles_deg: tuple[float, float], seed: int) -> None:
    evidence = judge(samples(*angles_deg, seed=seed))
    assert evidence.chosen
    assert (evidence.vertical_deg, evidence.azimuth_deg) == pytest.approx(angles_deg, abs=0.03), "three sigmas and more"
    assert evidence.chi2_before is not None
    assert evidence.chi2_after is not None
    assert evidence.chi2_after < evidence.chi2_before


@pytest.mark.parametrize("seed", range(3))
def test_angles_that_come_and_go_are_believed(seed: int) -> None:
    evidence = judge(samples(wander(0.12, seed), wander(0.12, seed + 10), seed=seed))
    assert evidence.chosen
    assert evidence.vertical_change_deg == pytest.approx(0.12, abs=0.06)
    assert evidence.azimuth_change_deg == pytest.approx(0.12, abs=0.06)


@pytest.mark.parametrize("seed", range(5))
def test_no_angle_is_no_bend(seed: int) -> None:
    assert not judge(samples(seed=seed)).chosen


@pytest.mark.parametrize("angle_deg", [(0.1, 0.0), (0.0, 0.1)])
def test_few_drives_are_straightened_that_a_small_angle_did_not_bend(angle_deg: tuple[float, float]) -> None:
    """5 of 100 at most in the mean; more than 10 in one of 90 such tests."""
    assert sum(judge(samples(*angle_deg, followed=0.0, seed=seed)).chosen for seed in range(100)) <= 10


@pytest.mark.parametrize("angle_deg", [-0.03, 0.03])
def test_a_constant_that_estimates_may_be_off_by_is_left_alone(angle_deg: float) -> None:
    evidence = judge(samples(angle_deg))
    assert not evidence.chosen
    assert "within the error of their estimates" in evidence.reason


@pytest.mark.parametrize("seed", range(3))
def test_angles_that_the_odometry_did_not_follow_are_left_alone(seed: int) -> None:
    """As with an odometry that knows the direction of gravity."""
    evidence = judge(samples(0.4, -0.3, followed=0.0, seed=seed))
    assert not evidence.chosen
    assert "held-out" in evidence.reason


def test_one_wild_stretch_does_not_decide() -> None:
    wild = samples(0.2, followed=0.0)
    wild.excess_rad_per_m[:4, 0] = np.radians(0.2) / BEND_M[0] * 20.0
    assert not judge(wild).chosen


@pytest.mark.parametrize("num", [0, LEAST_SAMPLES - 1])
def test_a_short_drive_says_nothing(num: int) -> None:
    evidence = judge(samples(0.4, num=num))
    assert not evidence.chosen
    assert evidence.vertical_deg is None
    assert evidence.reason == f"{num} pairs of scans, {LEAST_SAMPLES} needed"


def test_the_angle_may_change_slowly() -> None:
    truth_deg = 0.2 + wander(0.1, 3)
    vertical, _ = fitted(samples(truth_deg))
    error_deg = np.degrees(vertical.at(TRAVEL_M)) - truth_deg
    assert np.sqrt(np.mean(error_deg**2)) < 0.05, "below the noise of a sample, and below the change"


def test_what_is_held_out_is_expected_from_what_shares_no_scan_with_it() -> None:
    """Against the same expectation from a fit to the others alone, the slow way."""
    made = samples(0.2 + wander(0.1, 3))
    vertical, _ = fitted(made)
    start = 40
    out = slice(start - MARGIN, start + STRETCH + MARGIN)
    others = np.delete(np.arange(len(TRAVEL_M)), out)
    covariance = np.linalg.inv(vertical.precision)
    expected = covariance[out][:, others] @ np.linalg.solve(
        covariance[np.ix_(others, others)], vertical.deviation[others]
    )
    inner = slice(start, start + STRETCH)
    np.testing.assert_allclose(vertical.held_out()[inner], vertical.constant + expected[MARGIN:-MARGIN], atol=1e-9)


def test_a_failed_pair_of_scans_does_not_bend_the_estimate() -> None:
    made = samples(0.2 + wander(0.1, 3))
    rest = np.delete(np.arange(len(TRAVEL_M)), 30)
    without, _ = fitted(AngleSamples(TRAVEL_M[rest], made.angle_rad[rest], made.excess_rad_per_m[rest]))
    made.angle_rad[30] = 0.5
    failed, _ = fitted(made)
    np.testing.assert_allclose(failed.at(TRAVEL_M), without.at(TRAVEL_M), atol=1e-8)


def test_straightening_undoes_the_bend() -> None:
    truth, turns = block(40.0, rounds=1.0), (1e-4, -2e-4)
    motions = [geometry.inverse(a) @ b for a, b in itertools.pairwise(bent(truth, *turns))]
    turned_rad = np.tile(np.array(turns) * STEP_M, (len(motions), 1))
    edges = straightened([Edge(i, i + 1, motion, np.eye(6)) for i, motion in enumerate(motions)], turned_rad)
    for edge, (T_a, T_b) in zip(edges, itertools.pairwise(truth), strict=True):
        np.testing.assert_allclose(edge.T_a_b, geometry.inverse(T_a) @ T_b, atol=1e-12)
        np.testing.assert_allclose(edge.information, STRAIGHTENED_WORTH * np.eye(6))


def test_a_bent_drive_comes_out_straight_beyond_its_loops_too() -> None:
    truth = block(120.0, rounds=1.5)
    made = samples(0.3)
    graph = graph_of(bent(truth, np.radians(0.3) / BEND_M[0]))
    graph.add_closure(closure(truth, 260, 20))
    plain = np.abs(graph.finish().T_world_keyframe[359][2, 3])
    graph.straighten(made)
    estimate = graph.finish()
    heights = [abs(T_world_keyframe[2, 3]) for T_world_keyframe in estimate.T_world_keyframe.values()]
    assert plain > 0.5, "else there is nothing to straighten"
    assert max(heights) < 0.2 * plain


def test_straightening_again_starts_from_the_odometry() -> None:
    T_odom = bent(block(40.0, rounds=1.0), 1e-4)
    once, twice = graph_of(T_odom[:-1]), graph_of(T_odom[:-1])
    twice.straighten(samples(-0.3))
    for graph in (once, twice):
        graph.add_keyframe(len(T_odom) - 1, T_odom[-1], STEP_M * (len(T_odom) - 1))
        graph.straighten(samples(0.3))
        graph.finish()
    np.testing.assert_allclose(twice.T_world_keyframes, once.T_world_keyframes, atol=1e-6)
