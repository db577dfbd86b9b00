"""Odometry that jumps or breaks, on a drive with known true poses."""

from itertools import pairwise

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.core.types import Alignment, GraphEstimate, LoopClosure, Registration
from segslam.graph import PoseGraph
from segslam.graph.noise import odometry_information

CONFIG = GraphConfig()
ANGLES = np.linspace(0.0, 4.0 * np.pi, 160)
TRUTH = np.array([geometry.transform(geometry.yaw(a), [60 * np.sin(a), 60 - 60 * np.cos(a), 0.0]) for a in ANGLES])
"""Two rounds of a circle, a keyframe each 4.7 m; keyframe k of the second round is where k - 79.5 was."""
SIGMAS = geometry.tangent(rotation_rad=np.radians(0.1), translation_m=0.05)
JUMP = geometry.transform(geometry.yaw(np.radians(40.0)), [3.0, 0.0, 0.0])
AT = 117
"""The motion after this keyframe jumps."""
BEFORE = [(source, source - 80) for source in range(84, 117, 8)]
ACROSS = [(source, source - 80) for source in (119, 123, 127, 131, 140, 159)]
"""The last one is of the last keyframe."""
UNKNOWN = np.diag(geometry.tangent(rotation_rad=np.radians(60.0), translation_m=20.0) ** -2.0)


def odometry(seed: int, jumps: dict[int, np.ndarray]) -> np.ndarray:
    """Poses with the noise that is claimed, and a motion more after some keyframes."""
    rng = np.random.default_rng(seed)
    poses = [TRUTH[0]]
    for row, (T_world_a, T_world_b) in enumerate(pairwise(TRUTH)):
        T_a_b = geometry.inverse(T_world_a) @ T_world_b
        sigmas = np.diag(odometry_information(geometry.distance(T_a_b), T_a_b, CONFIG)) ** -0.5
        poses.append(poses[-1] @ T_a_b @ geometry.exp(sigmas * rng.normal(size=6)) @ jumps.get(row, np.eye(4)))
    return np.array(poses)


def closure(source: int, target: int, T_target_source: np.ndarray) -> LoopClosure:
    registration = Registration(T_target_source, 20, 20, 0.1, np.diag(SIGMAS**-2.0))
    return LoopClosure(
        source, target, T_target_source, registration.information, Alignment(registration, registration, 0.9, 0.1, 0.0)
    )


def true_closures(pairs: list[tuple[int, int]], seed: int) -> list[LoopClosure]:
    rng = np.random.default_rng([seed, 1])
    return [
        closure(s, t, geometry.inverse(TRUTH[t]) @ TRUTH[s] @ geometry.exp(SIGMAS * rng.normal(size=6)))
        for s, t in pairs
    ]


OUTLIERS = [
    closure(70, 30, geometry.transform(geometry.yaw(1.0), [3.0, 2.0, 0.0])),
    closure(135, 20, geometry.transform(geometry.yaw(-2.0), [0.0, 1.0, 0.5])),
]


def graph_of(
    T_odom: np.ndarray, loops: list[LoopClosure], *, unknown: tuple[int, ...] = (), config: GraphConfig = CONFIG
) -> PoseGraph:
    """`unknown`: keyframes of which the motion to them has next to no information."""
    graph = PoseGraph(config)
    travel_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T_odom[:, :3, 3], axis=0), axis=1))])
    for i, (T_odom_keyframe, travel) in enumerate(zip(T_odom, travel_m, strict=True)):
        graph.add_keyframe(i, T_odom_keyframe, float(travel), information=UNKNOWN if i in unknown else None)
    for loop in loops:
        graph.add_closure(loop)
    return graph


def ate_m(estimate: GraphEstimate) -> float:
    """Root mean square of the distances from the true poses; both begin with the first."""
    poses = np.array(list(estimate.T_world_keyframe.values()))
    return float(np.sqrt(np.mean(np.sum((poses[:, :3, 3] - TRUTH[:, :3, 3]) ** 2, axis=1))))


@pytest.mark.parametrize("seed", range(3))
def test_closures_that_are_consistent_with_each_other_beat_a_jump(seed: int) -> None:
    true = true_closures(BEFORE + ACROSS, seed)
    clean = graph_of(odometry(seed, {}), true).finish()
    assert clean.motion_weights == {}
    found = graph_of(odometry(seed, {AT: JUMP}), true + OUTLIERS).finish()
    assert found.motion_weights == {(AT, AT + 1): 0.0}
    assert [pair for pair, weight in found.closure_weights.items() if weight == 0.0] == [(70, 30), (135, 20)]
    assert ate_m(found) < 1.1 * ate_m(clean) + 0.02


def test_one_closure_does_not_beat_odometry() -> None:
    T_odom = odometry(0, {AT: JUMP})
    found = graph_of(T_odom, true_closures([*BEFORE, ACROSS[2]], 0) + OUTLIERS).finish()
    assert found.motion_weights == {}
    assert found.closure_weights[ACROSS[2]] == 0.0


def test_the_closures_of_one_place_do_not_beat_odometry() -> None:
    """As many as a repeated street may give: they may all be wrong by the same motion."""
    place = [(source, source - 80) for source in range(125, 131)]
    found = graph_of(odometry(0, {AT: JUMP}), true_closures(BEFORE + place, 0)).finish()
    assert found.motion_weights == {}
    assert {found.closure_weights[pair] for pair in place} == {0.0}


def test_two_jumps_are_found() -> None:
    T_other = geometry.transform(geometry.yaw(np.radians(-25.0)), [0.0, 2.0, 0.0])
    true = true_closures([(source, source - 80) for source in range(82, 160, 4)], 0)
    clean = graph_of(odometry(0, {}), true).finish()
    found = graph_of(odometry(0, {40: T_other, AT: JUMP}), true).finish()
    assert found.motion_weights == {(40, 41): 0.0, (AT, AT + 1): 0.0}
    assert set(found.closure_weights.values()) == {1.0}
    assert ate_m(found) < 1.1 * ate_m(clean) + 0.02


def test_a_rejected_motion_stays_rejected_and_is_written_without_information(tmp_path) -> None:
    true = true_closures(BEFORE + ACROSS, 0)
    graph = graph_of(odometry(0, {AT: JUMP}), true)
    first = graph.finish()
    running = graph.optimize()
    assert running.motion_weights == first.motion_weights
    assert ate_m(running) == pytest.approx(ate_m(first), abs=0.05)
    again = graph.finish()
    assert again.motion_weights == first.motion_weights
    assert ate_m(again) == pytest.approx(ate_m(first), abs=1e-3)


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 179.99])
@pytest.mark.parametrize("at_once", [True, False])
def test_a_break_is_closed_by_closures_from_either_side(yaw_deg: float, at_once: bool) -> None:
    T_break = geometry.transform(geometry.yaw(np.radians(yaw_deg)), [15.0, -20.0, 1.0])
    true = true_closures(BEFORE + ACROSS, 0)
    clean = graph_of(odometry(0, {}), true).finish()
    T_odom = odometry(0, {AT: T_break})
    graph = graph_of(T_odom, true if at_once else [], unknown=(AT + 1,))
    for loop in [] if at_once else true:
        graph.add_closure(loop)
        graph.optimize()
    if not at_once:
        running = np.array(graph.T_world_keyframes[:, :3, 3]) - TRUTH[:, :3, 3]
        assert np.linalg.norm(running, axis=1).max() < 3.0
    found = graph.finish()
    assert found.motion_weights == {}
    assert set(found.closure_weights.values()) == {1.0}
    assert ate_m(found) < 1.1 * ate_m(clean) + 0.02


def test_false_closures_do_not_win_a_break() -> None:
    """A group of one place, and single ones, against true closures of several places."""
    false = [closure(s, t, JUMP @ geometry.inverse(TRUTH[t]) @ TRUTH[s]) for s, t in ((122, 60), (123, 61), (124, 62))]
    T_break = geometry.transform(geometry.yaw(2.0), [10.0, 0.0, 0.0])
    true = true_closures(BEFORE + ACROSS, 0)
    found = graph_of(odometry(0, {AT: T_break}), false + OUTLIERS + true, unknown=(AT + 1,)).finish()
    assert {pair for pair, weight in found.closure_weights.items() if weight == 1.0} == set(BEFORE + ACROSS)


def test_a_false_closure_that_comes_first_does_not_hold_the_drive_after_a_break() -> None:
    T_break = geometry.transform(geometry.yaw(2.0), [10.0, 0.0, 0.0])
    graph = graph_of(odometry(0, {AT: T_break}), [], unknown=(AT + 1,))
    for loop in [OUTLIERS[1], *true_closures(ACROSS, 0)]:
        graph.add_closure(loop)
        running = graph.optimize()
    assert running.closure_weights[135, 20] < 0.01
    assert ate_m(running) < 1.0


def test_a_segment_without_closures_follows_the_one_before() -> None:
    T_odom = odometry(0, {40: JUMP})
    found = graph_of(T_odom, true_closures([(12, 3)], 0), unknown=(41,)).finish()
    last = geometry.inverse(found.T_world_keyframe[40]) @ found.T_world_keyframe[159]
    np.testing.assert_allclose(last, geometry.inverse(T_odom[40]) @ T_odom[159], atol=0.5)
