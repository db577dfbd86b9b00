"""Odometry whose heading drifts steadily, far beyond its noise: the graph corrects the drift and not only the ends."""

import numpy as np
import pytest
from graph.test_pose_graph import closure, noise_of, travel_m

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.graph import PoseGraph, steady_drift
from segslam.graph import graph as graph_module
from segslam.graph.levenberg_marquardt import Unsolvable

SIDES = ((70, 90.0), (70, 135.0), (100, 135.0))
"""Keyframes on each side of a triangular block, and the turn that follows (degrees). A round of a symmetric block does
not distinguish drift on its sides from drift in its turns."""
NUM_TURN, STEP_M = 19, 2.0
NUM_ROUND = sum(number for number, _ in SIDES) + 3 * NUM_TURN


def block() -> tuple[np.ndarray, np.ndarray]:
    """(n, 4, 4) poses of a round and a third, and (n,) seconds: turns are slower."""
    turns = np.concatenate([np.r_[np.zeros(k), np.full(NUM_TURN, np.radians(deg) / NUM_TURN)] for k, deg in SIDES])
    heading = np.cumsum(turns) - turns[0]
    steps = np.exp(1j * heading)
    first, second = slice(0, SIDES[0][0]), slice(SIDES[0][0] + NUM_TURN, SIDES[0][0] + NUM_TURN + SIDES[1][0])
    gap = steps.sum()  # the first two sides are as long as it takes to close the round
    lengths = np.full(NUM_ROUND, STEP_M)
    lengths[first] -= STEP_M * (gap * np.conj(steps[first])).real / SIDES[0][0]
    lengths[second] -= STEP_M * (gap * np.conj(steps[second])).real / SIDES[1][0]
    poses = [np.eye(4)]
    for number in range(NUM_ROUND * 4 // 3):
        turn, length = turns[number % NUM_ROUND], lengths[number % NUM_ROUND]
        poses.append(poses[-1] @ geometry.transform(geometry.yaw(turn), [length, 0.0, 0.0]))
    seconds = np.resize(np.where(turns > 0, 0.5, 0.2), len(poses) - 1)
    return np.array(poses), np.cumsum(np.concatenate([[0.0], seconds]))


def mapped_ate_m(rad_per_m: float, rad_per_s: float, *, walk: float = 0.0) -> tuple[float, float, PoseGraph]:
    """Errors (m) of the odometry and of the final poses, and the graph; `walk`: random rad per step."""
    truth, time_s = block()
    rng = np.random.default_rng(4)
    drift = rad_per_m * np.diff(travel_m(truth)) + rad_per_s * np.diff(time_s) + walk * rng.normal(size=len(truth) - 1)
    T_odom = [truth[0]]
    for T_a, T_b, angle in zip(truth[:-1], truth[1:], drift, strict=True):
        T_odom.append(T_odom[-1] @ geometry.inverse(T_a) @ T_b @ geometry.transform(geometry.yaw(angle), np.zeros(3)))
    graph = PoseGraph(GraphConfig())
    for number, (T, way_m, seconds) in enumerate(zip(T_odom, travel_m(truth), time_s, strict=True)):
        graph.add_keyframe(number, T, float(way_m), stamp_ns=int(1e9 * seconds))
    for source_id in range(NUM_ROUND, len(truth), 6):
        noise = geometry.exp(noise_of(0.02, 0.03) * rng.normal(size=6))
        loop = closure(source_id, source_id - NUM_ROUND, noise)
        if source_id == NUM_ROUND:
            graph.weigh_odometry_by(loop)
        graph.add_closure(loop)
        graph.optimize()
    graph.finish()
    return _ate_m(np.array(T_odom), truth), _ate_m(graph.T_world_keyframes, truth), graph


def _ate_m(poses: np.ndarray, truth: np.ndarray) -> float:
    """Without alignment: the first pose is fixed."""
    return float(np.sqrt(((poses[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize(("rad_per_m", "rad_per_s"), [pytest.param(8e-4, 0.0, marks=pytest.mark.long), (0.0, 6e-3)])
def test_a_large_steady_drift_leaves_hardly_more_error_than_a_small_one(rad_per_m: float, rad_per_s: float) -> None:
    _, small, _ = mapped_ate_m(rad_per_m / 100, rad_per_s / 100)
    odometry, large, graph = mapped_ate_m(rad_per_m, rad_per_s)
    assert odometry > 20.0
    assert large < 1.1 * small
    assert set(graph.finish().closure_weights.values()) == {1.0}


def test_a_drift_by_time_has_no_rate_by_travel(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []

    def noted(*about: object, tolerated: float) -> steady_drift.SteadyDrift | None:
        found.append(steady_drift.steady_drift(*about, tolerated=tolerated))
        return found[-1]

    monkeypatch.setattr(graph_module, "steady_drift", noted)
    mapped_ate_m(0.0, 6e-3)
    [drift] = found
    assert drift is not None
    np.testing.assert_allclose(drift.turns[:, 2], -6e-3 * np.diff(block()[1]), rtol=0.02)
    np.testing.assert_allclose(drift.turns[:, 2] / np.diff(block()[1]), drift.turns[0, 2] / block()[1][1], rtol=1e-7)


def test_a_random_drift_is_not_taken_for_a_steady_one(monkeypatch: pytest.MonkeyPatch) -> None:
    _, with_it, _ = mapped_ate_m(0.0, 0.0, walk=0.002)
    monkeypatch.setattr(graph_module, "steady_drift", lambda *about, tolerated: None)
    _, without, _ = mapped_ate_m(0.0, 0.0, walk=0.002)
    assert with_it == without


def test_a_correction_that_cannot_be_computed_leaves_the_solution_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise Unsolvable("x")

    monkeypatch.setattr(steady_drift, "search", fails)
    _, found, _ = mapped_ate_m(8e-4, 0.0)
    monkeypatch.setattr(graph_module, "steady_drift", lambda *about, tolerated: None)
    _, without, _ = mapped_ate_m(8e-4, 0.0)
    assert found == without
