"""Pairs of closures: chi-squares that hold what they claim, by plain sums and GTSAM; the largest set that agrees."""

import itertools

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as ScipyRotation
from scipy.stats import chi2, kstest

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.graph.closure_pairs import (
    _log_of_product,
    adjoints,
    consistent_pairs,
    largest_consistent,
    neighbours,
    num_near,
    pairwise_chi2,
)
from segslam.graph.edges import Edge, factor_graph
from segslam.graph.levenberg_marquardt import search
from segslam.graph.noise import inlier_bound, odometry_information

NOISE = geometry.tangent(rotation_rad=np.radians(0.2), translation_m=0.1)
BOUND = inlier_bound(0.99)


def drive(num: int = 200, rounds: float = 2.0) -> np.ndarray:
    """(n, 4, 4) true poses, so many rounds of a circle of 60 m radius."""
    angles = np.linspace(0.0, 2.0 * np.pi * rounds, num)
    return np.array([geometry.transform(geometry.yaw(a), [60 * np.sin(a), -60 * np.cos(a), 0]) for a in angles])


def odometry(T_world: np.ndarray, rng: np.random.Generator) -> list[Edge]:
    """Motions with the noise that they claim."""
    edges = []
    for i, (T_world_a, T_world_b) in enumerate(itertools.pairwise(T_world)):
        T_a_b = geometry.inverse(T_world_a) @ T_world_b
        information = odometry_information(geometry.distance(T_a_b), T_a_b, GraphConfig())
        noise = np.diag(information) ** -0.5 * rng.normal(size=6)
        edges.append(Edge(i, i + 1, T_a_b @ geometry.exp(noise), information))
    return edges


def closure(
    T_world: np.ndarray, target: int, source: int, rng: np.random.Generator, T_false: np.ndarray | None = None
) -> Edge:
    T_target_source = geometry.inverse(T_world[target]) @ T_world[source] @ geometry.exp(NOISE * rng.normal(size=6))
    return Edge(target, source, T_target_source if T_false is None else T_false @ T_target_source, np.diag(NOISE**-2.0))


def plain_chi2(edges: list[Edge], p: Edge, q: Edge) -> float:
    """The same loop in the frame of the first target, each motion's part in it added up."""
    poses = [np.eye(4)]
    for edge in edges:
        poses.append(poses[-1] @ edge.T_a_b)
    shift = [poses[edge.a] @ edge.T_a_b @ geometry.inverse(poses[edge.b]) for edge in (p, q)]
    covariance = np.zeros((6, 6))
    for step, edge in enumerate(edges):
        in_sources = (step >= p.b) - (step >= q.b)
        in_targets = (step >= p.a) - (step >= q.a)
        part = (in_sources * adjoints(shift[0][None])[0] - in_targets * np.eye(6)) @ adjoints(poses[step + 1][None])[0]
        covariance += part @ np.linalg.inv(edge.information) @ part.T
    for edge in (p, q):
        part = adjoints((poses[edge.a] @ edge.T_a_b)[None])[0]
        covariance += part @ np.linalg.inv(edge.information) @ part.T
    error = geometry.log(shift[0] @ geometry.inverse(shift[1]))
    return float(error @ np.linalg.solve(covariance, error))


def largest(edges: list[Edge], closures: list[Edge]) -> np.ndarray:
    return largest_consistent(consistent_pairs(edges, closures, BOUND))


def test_the_chi_square_of_two_closures_is_that_of_plain_sums() -> None:
    """Same and opposite directions, stretches apart and shared."""
    rng = np.random.default_rng(0)
    T_world = drive()
    edges = odometry(T_world, rng)
    closures = [
        closure(T_world, *ends, rng) for ends in ((3, 103), (40, 141), (80, 179), (20, 100), (10, 190), (9, 60))
    ]
    found = pairwise_chi2(edges, closures)
    for p, q in itertools.combinations(range(len(closures)), 2):
        assert found[p, q] == found[q, p] == pytest.approx(plain_chi2(edges, closures[q], closures[p]), rel=1e-6)


def test_the_noise_of_odometry_is_turned_with_a_jump_of_any_size() -> None:
    """Odometry that jumps 100 m and turns round: closures across the jump are as consistent as without it."""
    rng = np.random.default_rng(7)
    T_world = drive()
    edges = odometry(T_world, rng)
    closures = [closure(T_world, 3, 103, rng), closure(T_world, 40, 141, rng), closure(T_world, 10, 190, rng)]
    without = pairwise_chi2(edges, closures)
    T_jump = geometry.transform(geometry.yaw(3.0), [80.0, -60.0, 2.0])
    edges[60] = Edge(60, 61, edges[60].T_a_b @ T_jump, edges[60].information)
    np.testing.assert_allclose(pairwise_chi2(edges, closures), without, rtol=1e-6, atol=1e-9)


def test_a_loop_of_two_closures_is_as_unlikely_as_gtsam_finds_it() -> None:
    """The odometry between the two sources, and between the two targets, and both closures: one loop, nothing else."""
    rng = np.random.default_rng(1)
    T_world = drive()
    edges = odometry(T_world, rng)
    p, q = closure(T_world, 3, 103, rng), closure(T_world, 40, 141, rng)
    loop = factor_graph([*edges[3:40], *edges[103:141], p, q])
    loop.add(gtsam.PriorFactorPose3(3, gtsam.Pose3(T_world[3]), gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    start = gtsam.Values()
    for vertex in [*range(3, 41), *range(103, 142)]:
        start.insert(vertex, gtsam.Pose3(T_world[vertex]))
    assert pairwise_chi2(edges, [p, q])[0, 1] == pytest.approx(2.0 * search(loop, start).error, rel=0.02)


@pytest.mark.slow
def test_the_loops_of_true_closures_follow_the_chi_square_that_they_claim() -> None:
    """400 independent pairs, a drive each.

    The rotation of the drift is omitted; its effect is not measurable with 400 pairs.
    """
    rng = np.random.default_rng(2)
    T_world = drive(120)
    drawn = []
    for _ in range(400):
        closures = [closure(T_world, 5, 65, rng), closure(T_world, 40, 101, rng)]
        drawn.append(pairwise_chi2(odometry(T_world, rng), closures)[0, 1])
    assert kstest(drawn, chi2(6).cdf).pvalue > 0.01


def test_above_enough_the_chi_square_is_a_lower_bound() -> None:
    rng = np.random.default_rng(3)
    T_world = drive()
    edges = odometry(T_world, rng)
    T_false = geometry.transform(geometry.yaw(0.5), [5.0, 0.0, 0.0])
    closures = [closure(T_world, 3 + k, 103 + k, rng, T_false if k % 2 else None) for k in range(0, 60, 7)]
    whole, short = pairwise_chi2(edges, closures), pairwise_chi2(edges, closures, enough=BOUND)
    assert ((whole <= BOUND) == (short <= BOUND)).all()
    np.testing.assert_array_equal(whole[whole <= BOUND], short[whole <= BOUND])
    assert (short <= whole).all()


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-5, 0.3, 1.5, 2.0, 2.1, 3.0, np.pi - 1e-7])
def test_the_tangent_of_a_product_is_exact_up_to_half_a_turn(angle_rad: float) -> None:
    rng = np.random.default_rng(6)
    for axis in (*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))):
        rotation = angle_rad * axis / np.linalg.norm(axis)
        tangent = geometry.tangent(rotation_rad=rotation, translation_m=rng.normal(0.0, 5.0, 3))
        T_a_b = geometry.exp(rng.normal(size=6))
        T_b_c = geometry.inverse(T_a_b) @ geometry.exp(tangent)
        turns = [ScipyRotation.from_matrix(T[:3, :3]).as_quat() for T in (T_a_b, T_b_c)]
        found = np.empty(6)
        _log_of_product(T_a_b, turns[0], T_b_c, turns[1], found)
        np.testing.assert_allclose(found, tangent, atol=1e-7)


def test_closures_half_a_turn_apart_are_not_consistent() -> None:
    T_world = drive()
    rng = np.random.default_rng(4)
    turned = geometry.transform(geometry.yaw(np.pi), [0.0, 0.0, 0.0])
    closures = [closure(T_world, 3, 103, rng), closure(T_world, 40, 141, rng, turned)]
    assert pairwise_chi2(odometry(T_world, rng), closures)[0, 1] > 1e5


@pytest.mark.parametrize("seed", range(5))
def test_true_closures_are_consistent_among_groups_of_false_ones(seed: int) -> None:
    """Three groups of closures, all of a group with one error, as a repeated street gives."""
    rng = np.random.default_rng(seed)
    T_world = drive()
    edges = odometry(T_world, rng)
    true = [closure(T_world, 3 + k, 103 + k, rng) for k in range(0, 80, 5)]
    false = []
    for first in (10, 35, 60):
        slide = geometry.transform(np.eye(3), [rng.choice([-1.0, 1.0]) * rng.uniform(8.0, 20.0), 0.0, 0.0])
        false += [closure(T_world, first + k, 110 + first + k, rng, slide) for k in range(5)]
    chosen = largest(edges, true + false)
    assert not chosen[len(true) :].any()
    assert chosen[: len(true)].sum() >= len(true) - 4, "each pair of true ones is lost with one percent"


def test_without_closures_none_is_chosen() -> None:
    assert largest(odometry(drive(), np.random.default_rng(0)), []).shape == (0,)


def test_one_closure_is_consistent_with_itself() -> None:
    rng = np.random.default_rng(0)
    T_world = drive()
    assert largest(odometry(T_world, rng), [closure(T_world, 3, 103, rng)]).tolist() == [True]


def test_the_largest_set_is_searched_among_the_given_closures() -> None:
    agree = np.eye(6, dtype=bool)
    agree[:3, :3] = agree[3:5, 3:5] = True
    assert largest_consistent(agree).tolist() == [True] * 3 + [False] * 3
    assert largest_consistent(agree, np.arange(6) > 1).tolist() == [False] * 3 + [True, True, False]
    assert not largest_consistent(agree, np.zeros(6, dtype=bool)).any()


def test_an_adjoint_carries_a_tangent_to_the_other_side() -> None:
    rng = np.random.default_rng(5)
    T_a_b = geometry.exp(rng.normal(size=6))
    tangent = rng.normal(size=6)
    moved = T_a_b @ geometry.exp(tangent) @ geometry.inverse(T_a_b)
    np.testing.assert_allclose(geometry.exp(adjoints(T_a_b[None])[0] @ tangent), moved, atol=1e-12)


def test_closures_are_neighbours_where_both_ends_are_near() -> None:
    travel_m = np.array([0.0, 20.0, 100.0, 500.0, 520.0, 600.0])
    ends = [(0, 3), (1, 4), (2, 4), (1, 5)]
    edges = [Edge(a, b, np.eye(4), np.eye(6)) for a, b in ends]
    expected = np.eye(4, dtype=bool)
    expected[0, 1] = expected[1, 0] = True
    np.testing.assert_array_equal(neighbours(edges, travel_m, 30.0), expected)
    np.testing.assert_array_equal(num_near(edges, travel_m, 30.0), expected.sum(axis=1))
    assert neighbours([], travel_m, 30.0).shape == (0, 0)
    assert num_near([], travel_m, 30.0).shape == (0,)
