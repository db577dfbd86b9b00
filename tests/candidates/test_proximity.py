import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from segslam.candidates import proximity
from segslam.candidates.proximity import NO_CLOSURES, Chains, ProximityDetector, search_radius_m
from segslam.core import geometry
from segslam.core.config import ProximityConfig
from segslam.core.types import Alignment, LoopClosure, Registration

CONFIG = ProximityConfig(
    min_travel_m=50.0,
    base_radius_m=6.0,
    drift_ratio=0.01,
    max_radius_m=20.0,
)
ROUND = 100
"""Keyframes in one round of the square below, 2 m apart."""


@pytest.fixture(autouse=True)
def _dense_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """More candidates, nearer to each other, than in a drive."""
    monkeypatch.setattr(proximity, "MAX_CANDIDATES", 3)
    monkeypatch.setattr(proximity, "SPREAD_M", 6.0)
    monkeypatch.setattr(proximity, "MIN_GAP_M", 4.0)


def square(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 4, 4) and travel (n,) of rounds along a square of 50 m, one every 2 m, looking ahead."""
    poses, travel = [], 2.0 * np.arange(num)
    for way in travel % 200.0:
        side, along = divmod(way, 50.0)
        corner = np.array([[0, 0], [50, 0], [50, 50], [0, 50]])[int(side)]
        heading = side * np.pi / 2
        position = corner + along * np.array([np.cos(heading), np.sin(heading)])
        poses.append(geometry.transform(geometry.yaw(heading), [*position, 0.0]))
    return np.array(poses), travel


def closure(source_id: int, target_id: int) -> LoopClosure:
    registration = Registration(np.eye(4), 0, 0, 0.0, np.eye(6))
    alignment = Alignment(registration, registration, 1.0, 0.0, 0.0)
    return LoopClosure(source_id, target_id, np.eye(4), np.eye(6), alignment)


def radius_m(source_id: int, travel: np.ndarray, closures: np.ndarray) -> np.ndarray:
    return search_radius_m(Chains(closures).lengths_m(source_id, np.arange(len(travel)), travel), config=CONFIG)


def test_the_same_place_a_round_ago_is_proposed_first() -> None:
    poses, travel = square(ROUND + 13)
    found = ProximityDetector(CONFIG).candidates(ROUND + 12, poses, travel)
    assert found[0].source_id == ROUND + 12
    assert found[0].target_id == 12
    assert found[0].distance_m == pytest.approx(0.0, abs=1e-9)
    assert found[0].search_radius_m == pytest.approx(6.0 + 0.01 * 200.0)


def test_nothing_is_proposed_before_the_way_is_long_enough() -> None:
    poses, travel = square(ROUND)
    detector = ProximityDetector(CONFIG)
    assert all(detector.candidates(i, poses[: i + 1], travel[: i + 1]) == () for i in range(ROUND - 4))


def test_a_detour_shorter_than_the_least_travel_is_no_loop() -> None:
    poses = np.array([geometry.transform(np.eye(3), [min(x, 40.0 - x), 0, 0]) for x in np.arange(0.0, 41.0)])
    assert ProximityDetector(CONFIG).candidates(40, poses, np.arange(0.0, 41.0)) == ()


def test_several_candidates_are_ranked_by_distance_and_not_of_one_place() -> None:
    poses, travel = square(3 * ROUND + 13)
    poses[:ROUND, 1, 3] += 1.0
    poses[ROUND : 2 * ROUND, 1, 3] += 0.5
    found = ProximityDetector(CONFIG).candidates(3 * ROUND + 12, poses, travel)
    assert [candidate.target_id for candidate in found] == [2 * ROUND + 12, ROUND + 12, 12], "one of each round"
    assert [candidate.distance_m for candidate in found] == pytest.approx([0.0, 0.5, 1.0])


def test_two_candidates_of_one_visit_are_apart() -> None:
    poses, travel = square(ROUND + 13)
    found = ProximityDetector(CONFIG).candidates(ROUND + 12, poses, travel)
    assert [candidate.target_id for candidate in found] == [12, 9, 15], "6 m before and after"


def test_the_prior_is_the_source_in_the_target() -> None:
    poses, travel = square(ROUND + 13)
    drift = geometry.transform(geometry.yaw(0.1), [1.0, 2.0, 0.5])
    poses[ROUND:] = poses[ROUND:] @ drift
    found = ProximityDetector(CONFIG).candidates(ROUND + 12, poses, travel)
    expected = geometry.inverse(poses[found[0].target_id]) @ poses[ROUND + 12]
    np.testing.assert_allclose(found[0].T_target_source_prior, expected, atol=1e-12)
    assert found[0].distance_m == pytest.approx(geometry.distance(expected))


def test_another_storey_is_not_proposed() -> None:
    """Chains are of 200 m and up to 208: the height may drift by 1 m and 0.8 % of that, a storey is 3 m."""
    for height, is_proposed in ((2.55, True), (2.7, False), (3.0, False)):
        poses, travel = square(ROUND + 13)
        poses[:ROUND, 2, 3] += height
        assert bool(ProximityDetector(CONFIG).candidates(ROUND + 12, poses, travel)) is is_proposed, height


def test_a_candidate_carries_the_chain_that_its_bounds_follow_from() -> None:
    poses, travel = square(ROUND + 13)
    assert ProximityDetector(CONFIG).candidates(ROUND + 12, poses, travel)[0].chain_m == pytest.approx(200.0)


def test_the_radius_grows_with_the_way_and_no_farther_than_its_limit() -> None:
    travel = np.array([0.0, 100.0, 300.0, 2000.0])
    np.testing.assert_allclose(radius_m(3, travel, NO_CLOSURES), [20.0, 20.0, 20.0, 6.0])
    np.testing.assert_allclose(radius_m(2, travel, NO_CLOSURES), [9.0, 8.0, 6.0, 20.0])


def test_a_closure_shrinks_the_radius_around_both_its_ends() -> None:
    travel = np.array([0.0, 50.0, 500.0, 600.0, 650.0])
    closures = np.array([[3, 1], [3, 1]])
    radius = radius_m(4, travel, closures)
    np.testing.assert_allclose(radius, [6.0 + 1.0, 6.5, 6.0 + 1.5, 6.5, 6.0])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 6))
def test_the_chain_is_the_shortest_of_all_chains(seed: int, num_closures: int) -> None:
    """Against Floyd and Warshall's three loops."""
    rng = np.random.default_rng(seed)
    num = 12
    travel = np.cumsum(rng.uniform(0.0, 90.0, num))
    closures = np.sort(rng.integers(0, num, (num_closures, 2)), axis=1)[:, ::-1]
    closures = closures[closures[:, 0] - closures[:, 1] > 1]
    length = np.abs(travel[:, None] - travel)
    for source, target in closures:
        length[source, target] = length[target, source] = 0.0
    for via in range(num):
        length = np.minimum(length, length[:, [via]] + length[[via], :])
    chains = Chains(closures)
    for source in range(num):
        np.testing.assert_allclose(chains.lengths_m(source, np.arange(num), travel), length[source], rtol=1e-12)


def test_where_a_loop_was_just_closed_no_other_is_searched() -> None:
    poses, travel = square(ROUND + 20)
    detector = ProximityDetector(CONFIG)
    detector.note_closure(closure(ROUND + 12, 12))
    assert detector.candidates(ROUND + 13, poses, travel) == (), "2 m on, the same visit"
    assert detector.candidates(ROUND + 14, poses, travel), "4 m on"


def test_a_loop_just_closed_with_one_visit_does_not_stop_the_search_of_another() -> None:
    poses, travel = square(2 * ROUND + 20)
    detector = ProximityDetector(CONFIG)
    detector.note_closure(closure(2 * ROUND + 12, ROUND + 12))
    targets = [candidate.target_id for candidate in detector.candidates(2 * ROUND + 13, poses, travel)]
    assert targets[0] == 13
    assert all(target < ROUND - 3 for target in targets), targets


def test_a_loop_narrows_the_search_once_the_poses_are_such() -> None:
    poses, travel = square(ROUND + 40)
    poses[ROUND:, 1, 3] += 7.5  # beyond the radius without any drift, and all keyframes as far from their place
    detector = ProximityDetector(CONFIG)
    detector.note_closure(closure(ROUND + 12, 12))
    (found, *_) = detector.candidates(ROUND + 20, poses, travel)
    assert found.search_radius_m == pytest.approx(6.0 + 0.01 * 200.0)
    detector.note_estimate({(ROUND + 12, 12): 1.0})
    assert detector.candidates(ROUND + 20, poses, travel) == ()


def test_a_closure_that_the_optimiser_rejected_narrows_and_blocks_nothing() -> None:
    poses, travel = square(ROUND + 40)
    poses[ROUND:, 1, 3] += 7.5  # beyond the radius that a closure of length 0 would leave
    detector = ProximityDetector(CONFIG)
    unaware = detector.candidates(ROUND + 13, poses, travel)
    detector.note_closure(closure(ROUND + 12, 12))
    assert detector.candidates(ROUND + 13, poses, travel) == (), "just closed"
    detector.note_estimate({(ROUND + 12, 12): 0.01})
    again = detector.candidates(ROUND + 13, poses, travel)
    assert [found.target_id for found in again] == [found.target_id for found in unaware]
    assert [found.search_radius_m for found in again] == [found.search_radius_m for found in unaware]
    detector.note_estimate({(ROUND + 12, 12): 0.9})
    assert detector.candidates(ROUND + 13, poses, travel) == (), "accepted by a later optimisation"


def test_an_old_keyframe_may_be_searched_again_among_those_before_it() -> None:
    poses, travel = square(3 * ROUND)
    found = ProximityDetector(CONFIG).candidates(ROUND + 12, poses, travel)
    assert {candidate.target_id for candidate in found} == {12, 9, 15}


def test_moving_and_turning_the_world_changes_no_candidate() -> None:
    poses, travel = square(ROUND + 30)
    poses[:, 0, 3] += 0.01 * np.arange(len(poses))  # no two at the same distance
    T_new_world = geometry.transform(geometry.yaw(1.0), [100.0, -50.0, 7.0])
    before = ProximityDetector(CONFIG).candidates(ROUND + 29, poses, travel)
    after = ProximityDetector(CONFIG).candidates(ROUND + 29, T_new_world @ poses, travel)
    assert [candidate.target_id for candidate in before] == [candidate.target_id for candidate in after]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_allclose(old.T_target_source_prior, new.T_target_source_prior, atol=1e-9)


def test_the_first_keyframe_has_no_candidate() -> None:
    assert ProximityDetector(CONFIG).candidates(0, np.eye(4)[None], np.zeros(1)) == ()
