"""A bend that closures cannot see, scans that can, and a decision by stretches of the drive held out of the fit."""

import itertools

import numpy as np
import pytest

from segslam import geometry
from segslam.config import GraphConfig
from segslam.pose_graph import PoseGraph, judge
from segslam.pose_graph.drift import BEND_M, NUM_STRETCHES, SAMPLE_SIGMA_RAD, smoothed_angle, straightened
from segslam.pose_graph.edges import Edge
from segslam.types import Alignment, AngleSamples, LoopClosure, Registration

STEP_M = 2.0
TRAVEL_M = np.arange(10.0, 1210.0, 20.0)
EXCESS_SIGMA = np.radians(0.004)
"""Of one pair of scans, rad/m: as on simulated 06."""


def pitched(T_world: np.ndarray, pitch_rad_per_m: float) -> np.ndarray:
    """Odometry that turns down (half before and half after each motion) with every metre."""
    half = geometry.exp(geometry.tangent(rotation_rad=[0.0, pitch_rad_per_m * STEP_M / 2, 0.0], translation_m=0.0))
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
    angle_deg: float, *, excess_of_angle: float = 1.0 / BEND_M, seed: int = 0, num: int = len(TRAVEL_M)
) -> AngleSamples:
    """Pairs of scans that err as real ones do, on a drive whose odometry turns by so much of the angle each metre."""
    rng = np.random.default_rng(seed)
    angle = np.full(num, np.radians(angle_deg))
    return AngleSamples(
        TRAVEL_M[:num],
        angle + SAMPLE_SIGMA_RAD * rng.normal(size=num),
        excess_of_angle * angle + EXCESS_SIGMA * rng.normal(size=num),
    )


def test_loops_close_as_well_on_a_bent_world_as_on_a_flat_one() -> None:
    """Why closures are not asked: what lifts this drive by metres opens its loop by centimetres."""
    truth = block(120.0, rounds=1.5)
    T_odom = pitched(truth, np.radians(0.3) / BEND_M)
    source, target = 260, 20
    lifted_m = np.abs(T_odom[:, 2, 3]).max()
    true, bent = (closure(T_world, source, target).T_target_source for T_world in (truth, T_odom))
    opened = geometry.inverse(true) @ bent
    assert lifted_m > 1.0
    assert geometry.distance(opened) < 0.06, "as much as closures err"
    assert geometry.angle(opened) < np.radians(0.02), "of 3 degrees pitched in all"


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("angle_deg", [-0.4, -0.13, 0.13, 0.4])
def test_an_angle_that_bends_the_odometry_is_believed(angle_deg: float, seed: int) -> None:
    evidence = judge(samples(angle_deg, seed=seed))
    assert evidence.chosen
    assert evidence.angle_deg == pytest.approx(angle_deg, abs=0.03), "three sigmas of 60 samples"
    assert evidence.chi2_before is not None
    assert evidence.chi2_after is not None
    assert evidence.chi2_after < evidence.chi2_before


@pytest.mark.parametrize("seed", range(5))
def test_no_angle_is_no_bend(seed: int) -> None:
    assert not judge(samples(0.0, seed=seed)).chosen


def test_few_drives_are_straightened_that_a_small_angle_did_not_bend() -> None:
    """2 of 100 in the mean; more than 6 in one of 200 such tests."""
    assert sum(judge(samples(0.1, excess_of_angle=0.0, seed=seed)).chosen for seed in range(100)) <= 6


@pytest.mark.parametrize("angle_deg", [-0.05, 0.05])
def test_an_angle_that_estimates_may_be_off_by_is_left_alone(angle_deg: float) -> None:
    evidence = judge(samples(angle_deg))
    assert not evidence.chosen
    assert "within the error of the estimate" in evidence.reason


@pytest.mark.parametrize("seed", range(3))
def test_an_angle_that_the_odometry_did_not_follow_is_left_alone(seed: int) -> None:
    """As with an odometry that knows the direction of gravity."""
    evidence = judge(samples(0.4, excess_of_angle=0.0, seed=seed))
    assert not evidence.chosen
    assert "held-out" in evidence.reason


def test_one_wild_stretch_does_not_decide() -> None:
    wild = samples(0.2, excess_of_angle=0.0)
    wild.excess_rad_per_m[:4] = np.radians(0.2) / BEND_M * 20.0
    assert not judge(wild).chosen


@pytest.mark.parametrize("num", [0, 2 * NUM_STRETCHES - 1])
def test_a_short_drive_says_nothing(num: int) -> None:
    evidence = judge(samples(0.4, num=num))
    assert not evidence.chosen
    assert evidence.angle_deg is None
    assert evidence.reason == f"{num} pairs of scans, {2 * NUM_STRETCHES} needed"


def test_the_angle_may_change_slowly() -> None:
    made = samples(0.2)
    slow = np.radians(0.08) * np.sin(TRAVEL_M / 150.0)
    changing = AngleSamples(made.travel_m, made.angle_rad + slow, made.excess_rad_per_m)
    error = np.degrees(smoothed_angle(changing, TRAVEL_M) - np.radians(0.2) - slow)
    assert np.sqrt(np.mean(error**2)) < 0.035, "below the noise of a sample, and below the change"


def test_a_failed_pair_of_scans_does_not_bend_the_estimate() -> None:
    made = samples(0.2)
    without = smoothed_angle(made.rows(np.delete(np.arange(60), 30)), TRAVEL_M)
    made.angle_rad[30] = 0.5
    np.testing.assert_allclose(smoothed_angle(made, TRAVEL_M), without, atol=1e-12)


def test_straightening_undoes_the_bend() -> None:
    truth, pitch = block(40.0, rounds=1.0), 1e-4
    motions = [geometry.inverse(a) @ b for a, b in itertools.pairwise(pitched(truth, pitch))]
    edges = straightened(
        [Edge(i, i + 1, motion, np.eye(6)) for i, motion in enumerate(motions)], np.full(len(motions), pitch * STEP_M)
    )
    for edge, (T_a, T_b) in zip(edges, itertools.pairwise(truth), strict=True):
        np.testing.assert_allclose(edge.T_a_b, geometry.inverse(T_a) @ T_b, atol=1e-12)


def test_a_bent_drive_comes_out_straight_beyond_its_loops_too() -> None:
    truth = block(120.0, rounds=1.5)
    made = samples(0.3)
    graph = graph_of(pitched(truth, np.radians(0.3) / BEND_M))
    graph.add_closure(closure(truth, 260, 20))
    plain = np.abs(graph.finish().T_world_keyframe[359][2, 3])
    graph.straighten(made)
    estimate = graph.finish()
    heights = [abs(T_world_keyframe[2, 3]) for T_world_keyframe in estimate.T_world_keyframe.values()]
    assert plain > 0.5, "else there is nothing to straighten"
    assert max(heights) < 0.2 * plain


def test_straightening_again_starts_from_the_odometry() -> None:
    T_odom = pitched(block(40.0, rounds=1.0), 1e-4)
    once, twice = graph_of(T_odom[:-1]), graph_of(T_odom[:-1])
    twice.straighten(samples(-0.3))
    for graph in (once, twice):
        graph.add_keyframe(len(T_odom) - 1, T_odom[-1], STEP_M * (len(T_odom) - 1))
        graph.straighten(samples(0.3))
        graph.finish()
    np.testing.assert_allclose(twice.T_world_keyframes, once.T_world_keyframes, atol=1e-6)
