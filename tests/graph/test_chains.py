"""Covariances along the shortest chains, against every chain and against drives with noise; the gate of a prior."""

import itertools
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from segslam.core import geometry
from segslam.core.config import Config, GraphConfig
from segslam.core.types import LoopCandidate, Rejected, RejectReason
from segslam.graph.chains import Chains, _length, far_from_prior, prior_gate
from segslam.graph.closure_pairs import adjoints
from segslam.graph.edges import Edge
from segslam.graph.noise import TURN_M, UNKNOWN_MOTION, odometry_information

CONFIG = GraphConfig()


def drive(num: int, rng: np.random.Generator) -> tuple[np.ndarray, list[Edge]]:
    """Poses of a winding drive, and its motions with noises of different sizes."""
    steps = [geometry.exp(np.array([*rng.normal(0.0, 0.2, 3), 2.0, *rng.normal(0.0, 0.1, 2)])) for _ in range(num - 1)]
    poses = np.array(list(itertools.accumulate(steps, np.matmul, initial=np.eye(4))))
    informations = [odometry_information(float(rng.uniform(1.0, 90.0)), step, CONFIG) for step in steps]
    return poses, [Edge(i, i + 1, step, own) for i, (step, own) in enumerate(zip(steps, informations, strict=True))]


def loop(poses: np.ndarray, a: int, b: int, sigma_m: float) -> Edge:
    sigmas = geometry.tangent(rotation_rad=sigma_m / TURN_M, translation_m=sigma_m)
    return Edge(a, b, geometry.inverse(poses[a]) @ poses[b], np.diag(sigmas**-2.0))


def composed(edges: list[Edge], path: list[int]) -> np.ndarray:
    """Covariance of the last vertex of a path in the first, link by link."""
    found = np.zeros((6, 6))
    for a, b in itertools.pairwise(path):
        edge = min((e for e in edges if {e.a, e.b} == {a, b}), key=_length)
        own, T_a_b = np.linalg.inv(edge.information), edge.T_a_b
        if edge.a == b:
            (turn,) = adjoints(T_a_b[None])
            own, T_a_b = turn @ own @ turn.T, geometry.inverse(T_a_b)
        (turn,) = adjoints(geometry.inverse(T_a_b)[None])
        found = turn @ found @ turn.T + own
    return found


def test_memory_does_not_grow_with_the_number_of_keyframes_compared() -> None:
    poses, odometry = drive(600, np.random.default_rng(0))
    chains = Chains(poses, odometry, [loop(poses, a, a + 300, 0.05) for a in range(300)])
    tracemalloc.start()
    for source in range(600):
        chains.covariances(source, np.array([0, 299]))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 10 * 600 * 288, "covariances from at most some keyframes to all others are kept"


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 6))
def test_the_covariance_is_that_of_the_shortest_chain(seed: int, num_loops: int) -> None:
    """Against Floyd and Warshall's three loops, and the links of the path one after the other."""
    rng = np.random.default_rng(seed)
    num = 12
    poses, odometry = drive(num, rng)
    pairs = np.sort(rng.integers(0, num, (num_loops, 2)), axis=1)
    loops = [loop(poses, a, b, rng.uniform(0.01, 0.3)) for a, b in pairs.tolist() if b > a]
    length = np.where(np.eye(num), 0.0, np.inf)
    path = {(i, j): [i, j] for i in range(num) for j in range(num)}
    for edge in (*odometry, *loops):
        length[edge.a, edge.b] = length[edge.b, edge.a] = min(length[edge.a, edge.b], _length(edge))
    for via, i, j in itertools.product(range(num), repeat=3):
        if length[i, via] + length[via, j] < length[i, j] - 1e-15:
            length[i, j] = length[i, via] + length[via, j]
            path[i, j] = [*path[i, via], *path[via, j][1:]]
    chains = Chains(poses, odometry, loops)
    for source in range(num):
        found = chains.covariances(source, np.arange(num))
        for target in range(num):
            expected = composed([*odometry, *loops], path[target, source]) if source != target else np.zeros((6, 6))
            np.testing.assert_allclose(found[target], expected, atol=1e-9, rtol=1e-6)


def test_a_vertex_that_is_added_is_as_one_of_the_start() -> None:
    poses, odometry = drive(30, np.random.default_rng(3))
    loops = [loop(poses, 2, 20, 0.05)]
    whole, grown = Chains(poses, odometry, loops), Chains(poses[:25], odometry[:24], loops)
    for row in range(25, 30):
        grown.add(poses[row], odometry[row - 1])
    ids = np.arange(29)
    np.testing.assert_allclose(grown.covariances(29, ids), whole.covariances(29, ids), rtol=1e-9, atol=1e-15)


def test_errors_of_drives_are_as_large_as_claimed() -> None:
    """The mean chi-square of the pose after 40 noisy motions, of 400 drives, is the number of its dimensions."""
    rng = np.random.default_rng(4)
    poses, odometry = drive(41, rng)
    (covariance,) = Chains(poses, odometry, []).covariances(40, np.array([0]))
    chi2 = []
    for _ in range(400):
        noises = [
            geometry.exp(rng.multivariate_normal(np.zeros(6), np.linalg.inv(edge.information))) for edge in odometry
        ]
        end = np.eye(4)
        for edge, noise in zip(odometry, noises, strict=True):
            end = end @ edge.T_a_b @ noise
        off = geometry.log(geometry.inverse(poses[40]) @ poses[0] @ end)
        chi2.append(off @ np.linalg.solve(covariance, off))
    assert np.mean(chi2) == pytest.approx(6.0, rel=0.15)


def test_a_break_is_a_large_covariance_and_a_loop_across_it_makes_it_small() -> None:
    poses, odometry = drive(30, np.random.default_rng(5))
    odometry[14] = Edge(14, 15, odometry[14].T_a_b, UNKNOWN_MOTION)
    (broken,) = Chains(poses, odometry, []).covariances(29, np.array([0]))
    assert np.sqrt(broken[3, 3]) > 900.0
    (joined,) = Chains(poses, odometry, [loop(poses, 3, 20, 0.05)]).covariances(29, np.array([0]))
    assert np.sqrt(np.diag(joined)[3:]).max() < 3.0


def outcome(T_prior_pose: np.ndarray, *, sigma_m: float = 0.3, slack_m: float = 0.0) -> Rejected | None:
    prior = geometry.transform(geometry.yaw(0.7), [5.0, -3.0, 0.2])
    sigmas = geometry.tangent(rotation_rad=np.radians(1.0), translation_m=sigma_m)
    candidate = LoopCandidate(1, 0, prior, 5.0, np.diag(sigmas**2))
    return far_from_prior(prior @ T_prior_pose, candidate, GraphConfig(error_allowance=3.0), slack_m=slack_m)


def test_a_pose_within_the_tolerated_errors_passes() -> None:
    """The bound is 4.1 standard deviations, times the allowance of 3."""
    assert outcome(np.eye(4)) is None
    assert outcome(geometry.exp(np.array([0.0, 0.0, np.radians(8.0), 2.0, 1.0, 0.5]))) is None


@pytest.mark.parametrize(
    "tangent", [(0.0, 0.0, np.pi, 0.0, 0.0, 0.0), (0.0, 0.0, 0.3, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 4.0)]
)
def test_a_pose_beyond_them_is_rejected_and_slack_lets_it_pass_unless_it_is_turned_round(tangent: tuple) -> None:
    found = outcome(geometry.exp(np.array(tangent)))
    assert found is not None
    assert found.reason is RejectReason.FAR_FROM_PRIOR
    assert "from the predicted pose" in found.detail
    with_slack = outcome(geometry.exp(np.array(tangent)), slack_m=2.0)
    assert (with_slack is None) is (tangent[2] < 3.0)


def test_a_pose_that_an_uncertain_prior_allows_is_excluded_by_a_certain_one() -> None:
    moved = geometry.transform(np.eye(3), [0.0, 3.0, 0.0])
    assert outcome(moved, sigma_m=0.3) is None
    assert outcome(moved, sigma_m=0.1) is not None


@pytest.mark.parametrize("away_m", [5.0, 7.0, 9.0])
def test_a_pose_is_excluded_beyond_the_radius_and_what_refinement_may_move_it(away_m: float) -> None:
    certain = LoopCandidate(1, 0, np.eye(4), 5.0, np.eye(6) * 1e-8)
    config = Config()
    assert config.proximity.base_radius_m == 6.0
    pose = geometry.transform(np.eye(3), [0.0, away_m, 0.0])
    gate = prior_gate(certain, config)
    assert (gate(pose, slack_m=0.0) is None) is (away_m < 6.0)
    assert (gate(pose, slack_m=2.0) is None) is (away_m < 8.0)
