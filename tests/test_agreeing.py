"""Lies that agree with each other and are many, on a drive with known truth."""

from itertools import pairwise

import gtsam
import numpy as np

from segslam import geometry
from segslam.config import GraphConfig
from segslam.pose_graph.agreeing import believe_agreeing
from segslam.pose_graph.consistency import agreements, ends_m, largest_agreeing, neighbours
from segslam.pose_graph.edges import Edge, factor_graph
from segslam.pose_graph.gnc import TruncatedProblem, settle, settle_from
from segslam.pose_graph.noise import first_pose, inlier_bound, odometry_information

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
LIES = [closure(source, 12.0) for source in range(89, 99)]


def problem_of(closures: list[Edge]) -> tuple[TruncatedProblem, gtsam.Values, np.ndarray, np.ndarray]:
    """The drive with exact odometry; the truth; which closures agree, and which join the same places.

    The closures of one place have the say of two, as the graph gives them.
    """
    motions = [geometry.inverse(a) @ b for a, b in pairwise(TRUTH)]
    odometry = [
        Edge(i, i + 1, T, odometry_information(geometry.distance(T), T, GraphConfig())) for i, T in enumerate(motions)
    ]
    trusted = factor_graph(odometry)
    trusted.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(TRUTH[0]), first_pose()))
    values = gtsam.Values()
    for i, T_world in enumerate(TRUTH):
        values.insert(i, gtsam.Pose3(T_world))
    near = neighbours(ends_m(closures, 6.0 * np.arange(len(TRUTH))), 59.0)
    says = np.minimum(1.0, 2.0 / near.sum(axis=1))
    agree = agreements(odometry, closures, BOUND)
    return TruncatedProblem(trusted, closures, BOUND, says=says), values, agree, near


def test_lies_that_outnumber_the_true_closures_of_their_place_are_found_out() -> None:
    closures = TRUE + LIES
    problem, truth, agree, near = problem_of(closures)
    are_lies = np.arange(len(closures)) >= len(TRUE)
    most = largest_agreeing(agree, np.ones(len(closures), dtype=bool))
    assert most[are_lies].all(), "else the lies are not the larger party"
    misled = settle_from(problem, truth, most)
    assert misled.weights[are_lies].all(), "else they would be given up without being found out"
    found = believe_agreeing(problem, misled.search.values, agree, near)
    assert found.weights.tolist() == [1.0] * len(TRUE) + [0.0] * len(LIES)
    assert found.truncated_cost < misled.truncated_cost


def test_without_lies_all_are_believed() -> None:
    problem, truth, agree, near = problem_of(TRUE)
    assert believe_agreeing(problem, truth, agree, near).weights.all()


def test_without_closures_odometry_is_left_alone() -> None:
    problem, truth, agree, near = problem_of([])
    found = believe_agreeing(problem, truth, agree, near)
    assert found.weights.shape == (0,)
    np.testing.assert_allclose(found.search.values.atPose3(159).matrix(), TRUTH[159], atol=1e-9)


def test_a_group_of_two_is_not_worth_a_trial() -> None:
    problem, truth, agree, near = problem_of([*TRUE, *LIES[:2]])
    assert believe_agreeing(problem, truth, agree, near).truncated_cost <= settle(problem, truth).truncated_cost
