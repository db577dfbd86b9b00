"""Loops of known truth, with known drift and known false closures."""

import itertools
import subprocess
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2, kstest

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.core.types import Alignment, GraphEstimate, LoopClosure, Placement, Registration, SegslamError
from segslam.graph import AnchoredGraph, PoseGraph, noise
from segslam.graph.edges import Edge, factor_graph, squared_errors
from segslam.graph.g2o import read_g2o
from segslam.graph.graph import BREAK_LENGTH_M
from segslam.graph.levenberg_marquardt import Unsolvable
from segslam.graph.noise import closure_information, inlier_bound, odometry_information

CONFIG = GraphConfig()


def noise_of(metres: float, degrees: float) -> np.ndarray:
    return geometry.tangent(rotation_rad=np.radians(degrees), translation_m=metres)


CLOSURE_SIGMAS = noise_of(0.05, 0.1)


def circle(num: int, *, rounds: float = 2.0, radius_m: float = 30.0) -> np.ndarray:
    """(n, 4, 4) poses on a circle that is driven `rounds` times, gently up and down; the first is the identity."""
    poses = []
    for angle in np.linspace(0.0, 2.0 * np.pi * rounds, num):
        position = [radius_m * np.sin(angle), radius_m * (1.0 - np.cos(angle)), 2.0 * np.sin(angle)]
        poses.append(geometry.transform(geometry.yaw(angle), position))
    return np.array(poses)


def travel_m(poses: np.ndarray) -> np.ndarray:
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def drifted(T_world: np.ndarray, *, step: np.ndarray) -> np.ndarray:
    """Odometry that adds the same tangent to every motion."""
    T_odom = [T_world[0]]
    for T_a, T_b in itertools.pairwise(T_world):
        T_odom.append(T_odom[-1] @ geometry.inverse(T_a) @ T_b @ geometry.exp(step))
    return np.array(T_odom)


def closure(source_id: int, target_id: int, T_target_source: np.ndarray) -> LoopClosure:
    registration = Registration(T_target_source, 20, 20, 0.1, np.diag(CLOSURE_SIGMAS**-2.0))
    alignment = Alignment(registration, registration, 0.9, 0.1, 0.0)
    return LoopClosure(source_id, target_id, T_target_source, registration.information, alignment)


def true_closure(T_world: np.ndarray, source_id: int, target_id: int) -> LoopClosure:
    return closure(source_id, target_id, geometry.inverse(T_world[target_id]) @ T_world[source_id])


def graph_of(T_odom: np.ndarray, closures: list[LoopClosure], config: GraphConfig = CONFIG) -> PoseGraph:
    graph = PoseGraph(config)
    for i, (T_odom_keyframe, travel) in enumerate(zip(T_odom, travel_m(T_odom), strict=True)):
        graph.add_keyframe(i, T_odom_keyframe, float(travel))
    for loop in closures:
        graph.add_closure(loop)
    return graph


def greatest_error_m(T_world: np.ndarray, estimate: GraphEstimate) -> float:
    poses = np.array([estimate.T_world_keyframe[i] for i in range(len(T_world))])
    return float(np.linalg.norm(poses[:, :3, 3] - T_world[:, :3, 3], axis=1).max())


TRUTH = circle(120)
DRIFT = drifted(TRUTH, step=geometry.tangent(rotation_rad=[0, 0, 0.0004], translation_m=[0.01, 0, 0.01]))
LOOPS = [(source, source - 60) for source in range(62, 120, 6)]  # the second round meets the first
TRUE_LOOPS = [true_closure(TRUTH, source, target) for source, target in LOOPS]
FALSE_LOOPS = [
    closure(70, 30, geometry.transform(geometry.yaw(1.0), [3.0, 2.0, 0.0])),
    closure(95, 5, geometry.transform(geometry.yaw(-2.0), [0.0, 1.0, 0.5])),
    closure(110, 80, geometry.transform(np.eye(3), [0.0, 0.0, 0.0])),
]


def test_without_closures_the_estimate_is_the_odometry() -> None:
    graph = graph_of(DRIFT, [])
    np.testing.assert_allclose(graph.T_world_keyframes, DRIFT, atol=1e-9)
    np.testing.assert_allclose(graph.finish().T_world_keyframe[119], DRIFT[119], atol=1e-9)


@pytest.mark.parametrize("final", ["none", "gnc", "consistent"])
def test_a_graph_without_noise_stays_put(final: str) -> None:
    graph = graph_of(TRUTH, TRUE_LOOPS, GraphConfig(final=final))
    for estimate in (graph.optimize(), graph.finish()):
        assert estimate.error < 1e-9
        np.testing.assert_allclose(graph.T_world_keyframes, TRUTH, atol=1e-9)
        assert min(estimate.closure_weights.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("robust", ["none", "huber", "cauchy", "geman-mcclure"])
def test_closures_pull_the_drift_back(robust: str) -> None:
    graph = graph_of(DRIFT, TRUE_LOOPS, GraphConfig(robust=robust))
    before = float(np.linalg.norm(DRIFT[:, :3, 3] - TRUTH[:, :3, 3], axis=1).max())
    assert before > 1.5, "else there is nothing to pull"
    assert greatest_error_m(TRUTH, graph.optimize()) < 0.2 * before
    assert greatest_error_m(TRUTH, graph.finish()) < 0.2 * before


def test_a_closure_points_from_source_to_target(monkeypatch: pytest.MonkeyPatch) -> None:
    """A closure on a chain without information determines the pose: T_world_source = T_world_target T_target_source."""
    loose = GraphConfig(odometry_sigma_m=100.0, odometry_sigma_deg=90.0, robust="none")
    monkeypatch.setattr(noise, "CLOSURE_NOISE", np.diag(noise_of(1e-3, 0.08) ** 2))
    T_target_source = geometry.transform(geometry.yaw(0.7), [1.0, 2.0, 0.3])
    graph = graph_of(circle(5, rounds=0.1), [closure(4, 0, T_target_source)], loose)
    graph.optimize()
    np.testing.assert_allclose(graph.T_world_keyframes[4], T_target_source, atol=1e-3)


def test_a_closure_from_the_other_end_is_its_inverse() -> None:
    swapped = [closure(c.target_id, c.source_id, geometry.inverse(c.T_target_source)) for c in TRUE_LOOPS]
    config = GraphConfig(robust="none", final="none")
    first, second = graph_of(DRIFT, TRUE_LOOPS, config), graph_of(DRIFT, swapped, config)
    first.optimize()
    second.optimize()
    # the information of a tangent is bound to its end; both ends differ by the last centimetres of a good fit
    np.testing.assert_allclose(first.T_world_keyframes, second.T_world_keyframes, atol=0.02)


@pytest.mark.parametrize("most_paired", [0, 1_000])
@pytest.mark.parametrize("final", ["gnc", "consistent"])
def test_the_final_optimisation_rejects_false_closures_and_keeps_true_ones(
    final: str, most_paired: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("segslam.graph.motions.MAX_PAIRED", most_paired)
    graph = graph_of(DRIFT, TRUE_LOOPS + FALSE_LOOPS, GraphConfig(final=final))
    graph.optimize()
    estimate = graph.finish()
    assert [estimate.closure_weights[loop.source_id, loop.target_id] for loop in FALSE_LOOPS] == [0.0, 0.0, 0.0]
    assert [estimate.closure_weights[pair] for pair in LOOPS] == [1.0] * len(LOOPS)
    honest = graph_of(DRIFT, TRUE_LOOPS).finish()
    np.testing.assert_allclose(graph.T_world_keyframes[119], honest.T_world_keyframe[119], atol=1e-4)


@pytest.mark.parametrize("final", ["gnc", "consistent"])
def test_the_final_optimisation_keeps_true_closures_among_twice_as_many_false_ones(final: str) -> None:
    rng = np.random.default_rng(0)
    false = []
    for _ in range(2 * len(LOOPS)):
        target, source = np.sort(rng.choice(120, 2, replace=False))
        T_target_source = geometry.transform(geometry.yaw(rng.uniform(-np.pi, np.pi)), rng.normal(0.0, 3.0, 3))
        false.append(closure(int(source), int(target), T_target_source))
    weights = graph_of(DRIFT, TRUE_LOOPS + false, GraphConfig(final=final)).finish().closure_weights
    assert [weights[pair] for pair in LOOPS] == [1.0] * len(LOOPS)
    assert sum(weights.values()) == len(LOOPS)


@pytest.mark.parametrize("final", ["gnc", "consistent"])
def test_the_final_optimisation_may_reject_all(final: str) -> None:
    estimate = graph_of(TRUTH, FALSE_LOOPS, GraphConfig(final=final)).finish()
    assert set(estimate.closure_weights.values()) == {0.0}
    assert greatest_error_m(TRUTH, estimate) < 1e-6, "odometry was right, and is what is left"


def test_a_group_of_false_closures_with_one_error_does_not_outvote_the_odometry() -> None:
    """Twelve closures of one place, all 3 m off along the road: more than twelve bounds of chi-square, one mistake."""
    slide = geometry.transform(np.eye(3), [3.0, 0.0, 0.0])
    false = [closure(k, k - 25, slide @ true_closure(TRUTH, k, k - 25).T_target_source) for k in range(30, 42)]
    weights = graph_of(TRUTH, TRUE_LOOPS + false).finish().closure_weights
    assert [weights[loop.source_id, loop.target_id] for loop in false] == [0.0] * len(false)
    assert [weights[pair] for pair in LOOPS] == [1.0] * len(LOOPS)


def test_a_robust_kernel_limits_what_a_false_closure_can_do_while_running() -> None:
    loop = FALSE_LOOPS[:1]
    least_squares = graph_of(TRUTH, TRUE_LOOPS + loop, GraphConfig(robust="none")).optimize()
    robust = graph_of(TRUTH, TRUE_LOOPS + loop, GraphConfig(robust="cauchy")).optimize()
    assert greatest_error_m(TRUTH, robust) < 0.05 * greatest_error_m(TRUTH, least_squares)
    assert robust.closure_weights[70, 30] < 0.05
    assert min(robust.closure_weights[pair] for pair in LOOPS) > 0.95
    assert set(least_squares.closure_weights.values()) == {1.0}


def test_optimising_again_changes_nothing() -> None:
    graph = graph_of(DRIFT, TRUE_LOOPS)
    first = graph.optimize()
    second = graph.optimize()
    assert second.error == pytest.approx(first.error, rel=1e-6)
    np.testing.assert_allclose(first.T_world_keyframe[119], second.T_world_keyframe[119], atol=1e-3)


def test_closures_one_by_one_lead_where_all_at_once_do() -> None:
    config = GraphConfig(robust="none")
    at_once = graph_of(DRIFT, TRUE_LOOPS, config)
    at_once.optimize()
    graph = graph_of(DRIFT, [], config)
    for loop in TRUE_LOOPS:
        graph.add_closure(loop)
        graph.optimize()
    np.testing.assert_allclose(graph.T_world_keyframes, at_once.T_world_keyframes, atol=1e-3)


def test_a_keyframe_after_an_optimisation_follows_it_by_odometry() -> None:
    graph = graph_of(DRIFT[:119], TRUE_LOOPS[:-1])
    graph.optimize()
    T_world_118 = graph.T_world_keyframes[118]
    graph.add_keyframe(119, DRIFT[119], float(travel_m(DRIFT)[119]))
    expected = T_world_118 @ geometry.inverse(DRIFT[118]) @ DRIFT[119]
    np.testing.assert_allclose(graph.T_world_keyframes[119], expected, atol=1e-9)


def test_poses_given_out_are_not_touched_by_what_follows() -> None:
    graph = graph_of(DRIFT[:100], TRUE_LOOPS[:2])
    given = [graph.T_world_keyframes, graph.travel_m]
    copies = [array.copy() for array in given]
    for i in range(100, 120):
        graph.add_keyframe(i, DRIFT[i], float(travel_m(DRIFT)[i]))
    graph.optimize()
    for array, copy in zip(given, copies, strict=True):
        np.testing.assert_array_equal(array, copy)
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_the_more_closures_there_are_the_more_wait_for_an_optimisation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("segslam.graph.graph.CLOSURES_PER_WAITING", 2)
    graph, waited = graph_of(DRIFT, []), []
    for number, loop in enumerate(TRUE_LOOPS):
        assert not graph.is_due
        graph.add_closure(loop)
        if graph.is_due:
            graph.optimize()
            waited.append(number)
    assert waited == [0, 1, 3, 6], "after 1, 1, 2, 3 and next 4 closures"


LONG_DRIVE = """
import numpy as np
from segslam.graph.batch import optimize_graph
from segslam.graph.g2o import G2oGraph
from segslam.graph.edges import Edge
ahead = np.eye(4)
ahead[0, 3] = 1.0
poses = {i: np.eye(4) for i in range(12_000)}
for i in poses:
    poses[i][0, 3] = 1.001 * i
found = optimize_graph(G2oGraph(poses, [Edge(i, i + 1, ahead, np.eye(6)) for i in range(len(poses) - 1)]))
print(found.graph.T_world_vertex[11_999][0, 3])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ulimit")
def test_a_long_drive_does_not_exhaust_the_stack() -> None:
    """GTSAM calls itself along the drive: on a small stack 12,000 poses crash it as 100,000 do on the usual one."""
    command = ["bash", "-c", 'ulimit -s 192; exec "$0" -c "$1"', sys.executable, LONG_DRIVE]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(11_999.0, abs=0.01)


def test_moving_the_odometry_moves_the_world() -> None:
    T_new_odom = geometry.transform(geometry.yaw(1.0), [100.0, -50.0, 7.0])
    first, second = graph_of(DRIFT, TRUE_LOOPS), graph_of(T_new_odom @ DRIFT, TRUE_LOOPS)
    first.optimize()
    second.optimize()
    np.testing.assert_allclose(second.T_world_keyframes, T_new_odom @ first.T_world_keyframes, atol=1e-5)


def test_rotations_rounded_in_a_file_do_not_stop_the_solver() -> None:
    rounded = np.round(DRIFT, 5)
    estimate = graph_of(rounded, TRUE_LOOPS).optimize()
    exact = graph_of(DRIFT, TRUE_LOOPS).optimize()
    np.testing.assert_allclose(estimate.T_world_keyframe[119], exact.T_world_keyframe[119], atol=5e-3)


def test_the_written_graph_is_read_back_by_gtsam(tmp_path: Path) -> None:
    graph = graph_of(DRIFT, TRUE_LOOPS, GraphConfig(robust="none"))
    estimate = graph.optimize()
    graph.write_g2o(tmp_path / "graph.g2o")
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert factors.size() == 119 + len(LOOPS)
    assert factors.error(values) == pytest.approx(estimate.error, rel=1e-9)
    np.testing.assert_allclose(values.atPose3(119).matrix(), graph.T_world_keyframes[119], atol=1e-9)


def test_keyframes_must_come_in_order() -> None:
    graph = graph_of(TRUTH[:3], [])
    with pytest.raises(ValueError, match="expected 3, got 4"):
        graph.add_keyframe(4, np.eye(4), 0.0)


def test_a_closure_with_an_unknown_keyframe_is_refused() -> None:
    graph = graph_of(TRUTH[:3], [])
    with pytest.raises(SegslamError, match="keyframes 0 to 2, not 9"):
        graph.add_closure(closure(9, 0, np.eye(4)))


@pytest.mark.parametrize("value", [np.nan, -1.0])
def test_an_information_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="positive semidefinite"):
        closure_information(np.diag([1.0, 1.0, 1.0, 1.0, 1.0, value]))


def test_the_least_noise_is_added_to_a_closures_covariance() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    covariance = 1e-3 * (root @ root.T + np.eye(6))
    sigmas = noise_of(noise.CLOSURE_SIGMA_M, noise.CLOSURE_SIGMA_DEG)
    found = closure_information(np.linalg.inv(covariance))
    np.testing.assert_allclose(np.linalg.inv(found), covariance + np.diag(sigmas**2), rtol=1e-4)


def test_a_closure_without_information_in_one_direction_constrains_the_others() -> None:
    information = np.diag([1e6, 1e6, 1e6, 0.0, 1e4, 1e4])  # a corridor along x
    found = closure_information(information)
    assert np.linalg.eigvalsh(found).min() > 0.0
    assert found[3, 3] < 1e-3 < 10.0 < found[4, 4]


def test_a_motions_own_information_replaces_the_noise_of_odometry() -> None:
    """Two motions of 1 m where a closure measures 3 m for both: what is missing goes where the information is low."""
    T_next = geometry.transform(np.eye(3), [1.0, 0.0, 0.0])
    graph = PoseGraph(GraphConfig(robust="none"))
    graph.add_keyframe(0, np.eye(4), 0.0)
    graph.add_keyframe(1, T_next, 1.0)
    graph.add_keyframe(2, T_next @ T_next, 2.0, information=np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01]))
    graph.add_closure(closure(2, 0, geometry.transform(np.eye(3), [3.0, 0.0, 0.0])))
    graph.optimize()
    np.testing.assert_allclose(graph.T_world_keyframes[1:, 0, 3], [1.0, 3.0], atol=1e-4)


def test_a_motions_own_information_is_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    information = 1e4 * root @ root.T
    graph = PoseGraph(CONFIG)
    graph.add_keyframe(0, np.eye(4), 0.0)
    graph.add_keyframe(1, TRUTH[1], 1.0, information=information)
    graph.multiply_odometry_noise(100.0)
    graph.write_g2o(tmp_path / "graph.g2o")
    (edge,) = read_g2o(tmp_path / "graph.g2o").edges
    np.testing.assert_allclose(edge.information, information, atol=0.2, rtol=1e-3)


@pytest.mark.parametrize("value", [np.inf, -1.0])
def test_a_motion_with_an_information_that_is_none_is_refused_and_not_added(value: float) -> None:
    graph = graph_of(TRUTH[:2], [])
    with pytest.raises(ValueError, match="positive semidefinite"):
        graph.add_keyframe(2, TRUTH[2], 2.0, information=np.diag([1.0, 1.0, 1.0, 1.0, 1.0, value]))
    assert graph.num_keyframes == 2


def test_a_larger_odometry_noise_holds_for_all_motions_before_and_after(tmp_path: Path) -> None:
    loose = GraphConfig(odometry_sigma_m=0.05, odometry_sigma_deg=0.1)
    expected, found = graph_of(DRIFT, TRUE_LOOPS, loose), graph_of(DRIFT[:100], [])
    found.multiply_odometry_noise(5.0)
    for i in range(100, 120):
        found.add_keyframe(i, DRIFT[i], float(travel_m(DRIFT)[i]))
    for loop in TRUE_LOOPS:
        found.add_closure(loop)
    expected.finish()
    found.finish()
    np.testing.assert_allclose(found.T_world_keyframes, expected.T_world_keyframes, atol=1e-9)
    for name, graph in (("expected", expected), ("found", found)):
        graph.write_g2o(tmp_path / name)
    assert (tmp_path / "found").read_text() == (tmp_path / "expected").read_text()


def test_odometry_noise_grows_with_the_way_and_with_turns() -> None:
    ahead = geometry.transform(np.eye(3), [2.0, 0.0, 0.0])
    around = geometry.transform(geometry.yaw(1.0), [2.0, 0.0, 0.0])
    ways = ((2.0, ahead), (8.0, ahead), (2.0, around))
    sigmas = [np.diag(odometry_information(travel, T, CONFIG)) ** -0.5 for travel, T in ways]
    np.testing.assert_allclose(sigmas[1], 2.0 * sigmas[0], rtol=1e-9)
    np.testing.assert_allclose(sigmas[2] / sigmas[0], np.sqrt((2.0 + noise.TURN_M) / 2.0), rtol=1e-9)
    expected = geometry.tangent(
        rotation_rad=np.radians(CONFIG.odometry_sigma_deg), translation_m=CONFIG.odometry_sigma_m
    )
    np.testing.assert_allclose(sigmas[0], np.sqrt(2.0) * expected)


def test_a_standing_sensor_still_has_noise() -> None:
    assert np.isfinite(odometry_information(0.0, np.eye(4), CONFIG)).all()


def test_the_inlier_bound_is_the_chi_square_quantile() -> None:
    assert inlier_bound(0.99) == pytest.approx(16.8119, abs=1e-4), "tables, 6 degrees"
    assert inlier_bound(0.99, error_allowance=2.0) == pytest.approx(4 * 16.8119, abs=1e-3), "errors twice as large"


def test_the_squared_error_is_twice_gtsams() -> None:
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3())
    values.insert(1, gtsam.Pose3(geometry.transform(np.eye(3), [0.3, 0.0, 0.0])))
    edge = Edge(0, 1, np.eye(4), np.diag([1.0, 1.0, 1.0, 100.0, 1.0, 1.0]))
    np.testing.assert_allclose(squared_errors(factor_graph([edge]), values), [9.0])
    assert edge.factor(weight=0.5).error(values) == pytest.approx(9.0 / 4.0)


def gtsam_graph(graph: PoseGraph, folder: Path) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The prior, odometry and closures of a graph as GTSAM reads them from its file."""
    graph.write_g2o(folder / "graph.g2o")
    read, values = gtsam.readG2o(str(folder / "graph.g2o"), True)
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    factors.push_back(read)
    return factors, values


def test_gnc_agrees_with_gtsams_own(tmp_path: Path) -> None:
    """An independent solver of the same problem: same closures kept, same poses."""
    graph = graph_of(DRIFT, TRUE_LOOPS + FALSE_LOOPS, GraphConfig(final="gnc"))
    factors, values = gtsam_graph(graph, tmp_path)
    parameters = gtsam.GncLMParams()
    parameters.setKnownInliers(list(range(120)))
    optimizer = gtsam.GncLMOptimizer(factors, values, parameters)
    bound = inlier_bound(error_allowance=CONFIG.error_allowance)
    optimizer.setInlierCostThresholds(0.5 * bound)  # GTSAM bounds the error
    found = optimizer.optimize()
    weights = graph.finish().closure_weights
    np.testing.assert_allclose(optimizer.getWeights()[120:], list(weights.values()))
    np.testing.assert_allclose(graph.T_world_keyframes[119], found.atPose3(119).matrix(), atol=1e-4)


def test_the_end_is_the_batch_optimum(tmp_path: Path) -> None:
    """Closures one by one, under a kernel, then GNC: the same error as one tight search from the truth."""
    graph = graph_of(DRIFT, [])
    for loop in TRUE_LOOPS:
        graph.add_closure(loop)
        graph.optimize()
    end = graph.finish()
    factors, _ = gtsam_graph(graph, tmp_path)
    start = gtsam.Values()
    for i, T_world_keyframe in enumerate(TRUTH):
        start.insert(i, gtsam.Pose3(T_world_keyframe))
    tight = gtsam.LevenbergMarquardtParams.CeresDefaults()
    optimum = gtsam.LevenbergMarquardtOptimizer(factors, start, tight).optimize()
    assert end.error == pytest.approx(factors.error(optimum), rel=1e-6)


def test_errors_of_true_edges_match_their_information(tmp_path: Path) -> None:
    """Odometry and closures drawn from their noise: at the truth each has a chi-square of 6 degrees of freedom."""
    rng = np.random.default_rng(0)
    T_odom = [TRUTH[0]]
    least = noise_of(noise.CLOSURE_SIGMA_M, noise.CLOSURE_SIGMA_DEG)
    for T_a, T_b in itertools.pairwise(TRUTH):
        T_a_b = geometry.inverse(T_a) @ T_b
        way = geometry.distance(T_a_b) + noise.TURN_M * geometry.angle(T_a_b)
        sigmas = np.sqrt(way) * noise_of(CONFIG.odometry_sigma_m, CONFIG.odometry_sigma_deg)
        T_odom.append(T_odom[-1] @ T_a_b @ geometry.exp(sigmas * rng.normal(size=6)))
    sigmas = np.hypot(CLOSURE_SIGMAS, least)
    loops = [
        closure(c.source_id, c.target_id, c.T_target_source @ geometry.exp(sigmas * rng.normal(size=6)))
        for c in (true_closure(TRUTH, source, source - 60) for source in range(62, 120))
    ]
    graph_of(np.array(T_odom), loops).write_g2o(tmp_path / "graph.g2o")
    squared = [
        error @ edge.information @ error
        for edge in read_g2o(tmp_path / "graph.g2o").edges
        for error in [geometry.log(geometry.inverse(edge.T_a_b) @ geometry.inverse(TRUTH[edge.a]) @ TRUTH[edge.b])]
    ]
    assert kstest(squared[:119], chi2(6).cdf).pvalue > 0.01, "odometry"
    assert kstest(squared[119:], chi2(6).cdf).pvalue > 0.01, "closures"


def _fails(*_: object, **__: object) -> None:
    raise Unsolvable("near vertex 3")


def test_a_final_optimisation_that_fails_leaves_the_estimate_before_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    expected = graph_of(DRIFT, TRUE_LOOPS, GraphConfig(final="none")).finish()
    monkeypatch.setattr("segslam.graph.graph.solve_final", _fails)
    found = graph_of(DRIFT, TRUE_LOOPS, GraphConfig(final="consistent")).finish()
    assert "no final optimisation" in caplog.text
    for keyframe, T_world_keyframe in expected.T_world_keyframe.items():
        np.testing.assert_allclose(found.T_world_keyframe[keyframe], T_world_keyframe, atol=1e-9)


def test_an_optimisation_that_fails_leaves_all_poses(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    graph = graph_of(DRIFT, TRUE_LOOPS)
    monkeypatch.setattr("segslam.graph.graph.search", _fails)
    found = graph.optimize()
    assert "the poses remain" in caplog.text
    np.testing.assert_allclose(np.array(list(found.T_world_keyframe.values())), DRIFT, atol=1e-9)


def test_noise_that_loops_raise_does_not_make_later_motions_unsure() -> None:
    graph = PoseGraph(CONFIG)
    for number in range(6):
        if number == 3:
            graph.multiply_odometry_noise(30.0)
        graph.add_keyframe(number, geometry.transform(np.eye(3), [2.0 * number, 0.0, 0.0]), 2.0 * number)
    assert graph.motion_variance[0] == 0.0
    one = odometry_information(2.0, geometry.transform(np.eye(3), [2.0, 0.0, 0.0]), CONFIG)
    np.testing.assert_allclose(graph.motion_variance[1:], np.linalg.eigvalsh(np.linalg.inv(one)[3:, 3:])[-1])


def test_a_drift_whose_correction_cannot_be_solved_leaves_the_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = PoseGraph(CONFIG)
    truth = circle(40)
    for number, (T, at_m) in enumerate(zip(truth, travel_m(truth), strict=True)):
        graph.add_keyframe(number, T, float(at_m))
    graph.add_closure(true_closure(truth, 30, 10))
    solve, calls = graph._solve_final, []

    def once() -> float:
        calls.append(1)
        if len(calls) == 2:
            raise Unsolvable("x")
        return solve()

    monkeypatch.setattr(graph, "_solve_final", once)
    monkeypatch.setattr(graph, "_corrects_steady_drift", lambda: True)
    estimate = graph.finish()
    assert len(calls) == 2
    np.testing.assert_allclose(estimate.T_world_keyframe[39], truth[39], atol=1e-3)


def test_a_drive_in_a_map_has_the_breaks_and_the_travel_of_its_keyframes() -> None:
    graph = AnchoredGraph(CONFIG)
    for number in range(4):
        T_odom = geometry.transform(np.eye(3), [2.0 * number, 0.0, 0.0])
        graph.add_keyframe(number, T_odom, 2.0 * number, information=np.zeros((6, 6)) if number == 2 else None)
    assert graph.num_breaks.tolist() == [1, 1, 2, 2]
    np.testing.assert_allclose(np.diff(graph.travel_m), [2.0, 2.0 + BREAK_LENGTH_M, 2.0])


def test_between_keyframes_of_a_drive_in_a_map_the_covariances_are_those_of_its_motions() -> None:
    alone, in_map = PoseGraph(CONFIG), AnchoredGraph(CONFIG)
    for number, T_odom in enumerate(circle(6)):
        information = np.diag([4.0, 5.0, 6.0, 1.0, 2.0, 3.0]) * (number + 1.0)
        for graph in (alone, in_map):
            graph.add_keyframe(number, T_odom, 2.0 * number, information=information)
    known = true_closure(circle(6), 1, 0)
    in_map.place(Placement(0, 7, np.eye(4), known.information, known.alignment, is_found=True))
    alone.optimize()
    in_map.optimize()
    others = np.array([0, 2, 4])
    np.testing.assert_allclose(in_map.covariances(5, others), alone.covariances(5, others), rtol=1e-6, atol=1e-12)


def test_placements_in_a_map_have_the_weights_of_their_keyframes() -> None:
    graph = AnchoredGraph(CONFIG)
    for number in range(4):
        graph.add_keyframe(number, geometry.transform(np.eye(3), [2.0 * number, 0.0, 0.0]), 2.0 * number)
    known = true_closure(np.tile(np.eye(4), (4, 1, 1)), 1, 0)
    for number in (1, 3):
        T_world = geometry.transform(np.eye(3), [5.0 + 2.0 * number, 0.0, 0.0])
        graph.place(Placement(number, 7, T_world, known.information, known.alignment, is_found=True))
    estimate = graph.optimize()
    assert graph.weights.keys() == {1, 3}
    assert len(graph.motion_variance) == graph.num_keyframes
    assert min(graph.weights.values()) > 0.9
    np.testing.assert_allclose(estimate.T_world_keyframe[0][:3, 3], [5.0, 0.0, 0.0], atol=1e-3)


def test_the_first_placement_in_a_map_is_used_at_once_and_later_ones_in_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("segslam.graph.anchored.OPTIMIZE_EVERY", 3)
    graph, used_at = AnchoredGraph(CONFIG), []
    known = true_closure(np.tile(np.eye(4), (2, 1, 1)), 1, 0)
    for number in range(8):
        T_odom = geometry.transform(np.eye(3), [2.0 * number, 0.0, 0.0])
        graph.add_keyframe(number, T_odom, 2.0 * number)
        assert not graph.is_due
        graph.place(Placement(number, 7, T_odom, known.information, known.alignment, is_found=True))
        if graph.is_due:
            graph.optimize()
            used_at.append(number)
    assert used_at == [0, 3, 6]


def test_a_rejected_jump_of_the_odometry_is_no_drift() -> None:
    """A loop across it, confirmed after the final optimisation, does not make the odometry less certain."""
    truth = circle(240)
    jump = geometry.transform(np.eye(3), [60.0, 0.0, 0.0])
    odometry = truth.copy()
    odometry[130:] = odometry[129] @ jump @ geometry.inverse(truth[129]) @ truth[130:]
    graph = PoseGraph(CONFIG)
    for number, (T_odom, way_m) in enumerate(zip(odometry, travel_m(truth), strict=True)):
        graph.add_keyframe(number, T_odom, way_m)
    for source in range(140, 236, 4):
        graph.add_closure(true_closure(truth, source, source - 120))
    assert list(graph.finish().motion_weights) == [(129, 130)]
    graph.weigh_odometry_by(true_closure(truth, 237, 117))
    graph.add_closure(true_closure(truth, 237, 117))
    assert list(graph.finish().motion_weights) == [(129, 130)]
    assert np.linalg.norm((graph.T_world_keyframes - truth)[:, :3, 3], axis=1).max() < 1.0
