"""Many false closures that are consistent with each other, on a drive with known true poses."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.graph import gnc, levenberg_marquardt
from segslam.graph.closure_pairs import consistent_pairs, largest_consistent, neighbours
from segslam.graph.edges import Edge, factor_graph
from segslam.graph.gnc import TruncatedProblem, select_consistent, settle, settle_from
from segslam.graph.noise import FIRST_POSE, inlier_bound, odometry_information

BOUND = inlier_bound(0.99, error_allowance=3.0)
HEADINGS = np.linspace(0.0, 4.0 * np.pi, 160)
TRUTH = np.array([geometry.transform(geometry.yaw(a), [80 * np.sin(a), -80 * np.cos(a), 0.0]) for a in HEADINGS])
"""Two rounds of a circle, a keyframe each 6 m."""
INFORMATION = np.diag(geometry.tangent(rotation_rad=np.radians(0.1), translation_m=0.05) ** -2.0)


def closure(source: int, shift_m: float = 0.0) -> Edge:
    """With a round before, as if the world had moved by so much on the way."""
    target = source - 80
    T_world_moved = geometry.transform(np.eye(3), [shift_m, 0.0, 0.0])
    return Edge(target, source, geometry.inverse(TRUTH[target]) @ T_world_moved @ TRUTH[source], INFORMATION)


TRUE = [closure(source) for source in (*range(90, 100, 3), 120, 135, 150)]
FALSE = [closure(source, 12.0) for source in range(89, 99)]


def problem_of(closures: list[Edge]) -> tuple[TruncatedProblem, gtsam.Values, np.ndarray, np.ndarray]:
    """The drive with exact odometry; the true poses; which closures are consistent, and which join the same places.

    Rejecting the closures of one place costs as much as rejecting two.
    """
    motions = [geometry.inverse(a) @ b for a, b in pairwise(TRUTH)]
    odometry = [
        Edge(i, i + 1, T, odometry_information(geometry.distance(T), T, GraphConfig())) for i, T in enumerate(motions)
    ]
    trusted = factor_graph(odometry)
    trusted.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(TRUTH[0]), FIRST_POSE))
    values = gtsam.Values()
    for i, T_world in enumerate(TRUTH):
        values.insert(i, gtsam.Pose3(T_world))
    near = neighbours(closures, 6.0 * np.arange(len(TRUTH)), 59.0)
    penalties = np.minimum(1.0, 2.0 / near.sum(axis=1))
    agree = consistent_pairs(odometry, closures, BOUND)
    return TruncatedProblem(trusted, closures, BOUND, penalties), values, agree, near


def test_false_closures_that_outnumber_the_true_ones_of_their_place_are_rejected() -> None:
    closures = TRUE + FALSE
    problem, truth, agree, near = problem_of(closures)
    is_false = np.arange(len(closures)) >= len(TRUE)
    most = largest_consistent(agree)
    assert most[is_false].all(), "else the false ones are not the majority"
    misled = settle_from(problem, truth, most)
    assert misled.weights[is_false].all(), "else they would be rejected without a trial"
    found = select_consistent(problem, misled.search.values, agree, near)
    assert found.weights.tolist() == [1.0] * len(TRUE) + [0.0] * len(FALSE)
    assert found.truncated_cost < misled.truncated_cost


def test_the_iterations_of_graduated_non_convexity_are_all_linear_systems_solved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, truth, _, _ = problem_of(TRUE + FALSE)
    of_other_start = settle(problem, truth).search.iterations
    solved: list[int] = []

    def step(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        solved.append(1)
        return levenberg_marquardt.step(graph, values)

    def search(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> levenberg_marquardt.Search:
        found = levenberg_marquardt.search(graph, start)
        solved.append(found.iterations)
        return found

    monkeypatch.setattr(gnc, "step", step)
    monkeypatch.setattr(gnc, "search", search)
    monkeypatch.setattr(gnc, "better", lambda graduated, _: graduated)
    iterations = gnc.solve(problem, truth).search.iterations
    assert len(solved) > 5
    assert iterations == sum(solved) - of_other_start


def test_without_false_closures_none_is_rejected() -> None:
    problem, truth, agree, near = problem_of(TRUE)
    assert select_consistent(problem, truth, agree, near).weights.all()


def test_without_closures_odometry_is_left_alone() -> None:
    problem, truth, agree, near = problem_of([])
    found = select_consistent(problem, truth, agree, near)
    assert found.weights.shape == (0,)
    np.testing.assert_allclose(found.search.values.atPose3(159).matrix(), TRUTH[159], atol=1e-9)


def test_a_group_of_two_changes_nothing() -> None:
    problem, truth, agree, near = problem_of([*TRUE, *FALSE[:2]])
    assert select_consistent(problem, truth, agree, near).truncated_cost <= settle(problem, truth).truncated_cost


def test_the_inliers_that_are_consistent_with_a_rejected_group_stay_while_it_is_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A closure that is shifted by half as much as the false ones is consistent with both groups."""
    problem, truth, agree, near = problem_of([*TRUE, *FALSE, closure(155, 6.0)])
    misled = settle_from(problem, truth, largest_consistent(agree))
    inliers = misled.weights > 0.0
    group = largest_consistent(agree & near, ~inliers)
    assert not agree[:, group].mean(axis=1)[inliers].all(), "else all of them would stay"
    assert agree[:, group].all(axis=1)[inliers].any(), "else none would"
    tried = []

    def recorded(*arguments: object) -> gnc.Solution:
        tried.append(arguments[2])
        return settle_from(*arguments)

    monkeypatch.setattr(gnc, "settle_from", recorded)
    gnc.exchange_groups(problem, misled, agree, near)
    assert tried[0].tolist() == (group | inliers & (agree[:, group].mean(axis=1) >= 0.9)).tolist()
