from collections.abc import Callable

import numpy as np
import pytest

from segslam.candidates import proximity
from segslam.candidates.proximity import FARTHEST, ProximityDetector, nearness
from segslam.core import geometry
from segslam.core.config import ProximityConfig
from segslam.core.types import Alignment, LoopCandidate, LoopClosure, Registration

CONFIG = ProximityConfig(
    min_travel_m=50.0,
    base_radius_m=6.0,
)
ROUND = 100
"""Keyframes in one round of the square below, 2 m apart."""


@pytest.fixture(autouse=True)
def _dense_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """More candidates, nearer to each other, than in a drive."""
    monkeypatch.setattr(proximity, "MAX_CANDIDATES", 3)
    monkeypatch.setattr(proximity, "GAP_M", 6.0)


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


def covariance_of(sigma_m: float, height_m: float = 0.5) -> Callable[[int, np.ndarray], np.ndarray]:
    """Every keyframe as uncertain, in any of its horizontal directions."""
    one = np.diag(np.array([0.01, 0.01, 0.01, sigma_m, sigma_m, height_m]) ** 2)
    return lambda source_id, ids: np.repeat(one[None], len(ids), axis=0)


CERTAIN = covariance_of(0.8)


def found_by(source_id: int, poses: np.ndarray, travel: np.ndarray, sigma_m: float = 0.8) -> tuple[LoopCandidate, ...]:
    return ProximityDetector(CONFIG).candidates(source_id, poses, travel, covariance_of(sigma_m))


def test_the_same_place_a_round_ago_is_proposed_first() -> None:
    poses, travel = square(ROUND + 13)
    found = found_by(ROUND + 12, poses, travel)
    assert found[0].source_id == ROUND + 12
    assert found[0].target_id == 12
    assert found[0].distance_m == pytest.approx(0.0, abs=1e-9)
    assert found[0].near_probability == pytest.approx(1.0, abs=1e-6)


def test_nothing_is_proposed_before_the_way_is_long_enough() -> None:
    poses, travel = square(ROUND)
    detector = ProximityDetector(CONFIG)
    assert all(detector.candidates(i, poses[: i + 1], travel[: i + 1], CERTAIN) == () for i in range(ROUND - 4))


def test_a_detour_shorter_than_the_least_travel_is_no_loop() -> None:
    poses = np.array([geometry.transform(np.eye(3), [min(x, 40.0 - x), 0, 0]) for x in np.arange(0.0, 41.0)])
    assert found_by(40, poses, np.arange(0.0, 41.0)) == ()


def test_several_candidates_are_ranked_by_distance_and_not_of_one_place() -> None:
    poses, travel = square(3 * ROUND + 13)
    poses[:ROUND, 1, 3] += 1.0
    poses[ROUND : 2 * ROUND, 1, 3] += 0.5
    found = found_by(3 * ROUND + 12, poses, travel)
    assert [candidate.target_id for candidate in found] == [2 * ROUND + 12, ROUND + 12, 12], "one of each round"
    assert [candidate.distance_m for candidate in found] == pytest.approx([0.0, 0.5, 1.0])


def test_two_candidates_of_one_visit_are_apart() -> None:
    poses, travel = square(ROUND + 13)
    found = found_by(ROUND + 12, poses, travel)
    assert [candidate.target_id for candidate in found] == [12, 9, 15], "6 m before and after"


def test_the_prior_is_the_source_in_the_target() -> None:
    poses, travel = square(ROUND + 13)
    drift = geometry.transform(geometry.yaw(0.1), [1.0, 2.0, 0.5])
    poses[ROUND:] = poses[ROUND:] @ drift
    found = found_by(ROUND + 12, poses, travel)
    expected = geometry.inverse(poses[found[0].target_id]) @ poses[ROUND + 12]
    np.testing.assert_allclose(found[0].T_target_source_prior, expected, atol=1e-12)
    assert found[0].distance_m == pytest.approx(geometry.distance(expected))


def test_another_storey_is_not_proposed() -> None:
    """Heights may drift by 2.6 standard deviations beside 1 m; a storey is 3 m."""
    for height, is_proposed in ((2.2, True), (2.4, False), (3.0, False)):
        poses, travel = square(ROUND + 13)
        poses[:ROUND, 2, 3] += height
        assert bool(found_by(ROUND + 12, poses, travel)) is is_proposed, height


def test_the_higher_a_place_seems_to_be_the_less_probable_it_is() -> None:
    """By the chance that an error of the height explains what is beyond 1 m."""
    chances = []
    for height in (0.9, 1.5, 2.0):
        poses = np.stack([np.eye(4), geometry.transform(np.eye(3), [2.0, 0.0, height])])
        near = nearness(1, np.array([0]), poses, lambda *_: 0.25 * np.eye(6)[None], radius_m=6.0)
        assert near.probability[0] == pytest.approx(near.same_height[0], abs=1e-6)
        chances.append(near.same_height[0])
    assert chances == pytest.approx([1.0, 0.3173, 0.0455], abs=1e-4)


def test_a_place_out_of_the_radius_is_proposed_as_far_as_the_drift_makes_it_probable() -> None:
    for sigma_m, distance_m, is_proposed in (
        (0.8, 7.5, True),
        (0.8, 8.0, False),
        (4.0, 14.0, True),
        (4.0, 16.0, False),
        (30.0, 2.0, True),
        (60.0, 0.0, False),  # the place is almost unknown
    ):
        poses, travel = square(ROUND + 13)
        poses[:, 1, 3] = 0.0
        poses[:, 0, 3] = 1000.0 + travel
        poses[12, 0, 3] = poses[ROUND + 12, 0, 3] - distance_m
        poses[13:-1, 0, 3] += 1e4
        assert bool(found_by(ROUND + 12, poses, travel, sigma_m)) is is_proposed, (sigma_m, distance_m)


def test_the_probability_is_that_of_errors_drawn_at_random() -> None:
    """In a square of the same half width, along and across the direction to the other keyframe."""
    rng = np.random.default_rng(0)
    poses = np.stack([np.eye(4), geometry.transform(geometry.yaw(0.4), [5.0, 2.0, 0.0])])
    mix = rng.normal(size=(6, 6))
    covariance = mix @ np.diag([1e-4, 1e-4, 1e-4, 9.0, 9.0, 0.1]) @ mix.T
    near = nearness(1, np.array([0]), poses, lambda source_id, ids: covariance[None], radius_m=6.0)
    spread = poses[1, :3, :3] @ covariance[3:, 3:] @ poses[1, :3, :3].T
    ahead = np.array([5.0, 2.0]) / np.hypot(5.0, 2.0)
    ways = np.stack([ahead, [-ahead[1], ahead[0]]])
    along, across = ways @ spread[:2, :2] @ ways.T
    drawn = rng.normal(size=(200_000, 2)) * np.sqrt([along[0], across[1]]) + [np.hypot(5.0, 2.0), 0.0]
    assert near.probability[0] == pytest.approx(np.mean(np.abs(drawn).max(axis=1) < 6.0), abs=0.005)
    assert near.reach_m[0] == pytest.approx(6.0 + FARTHEST * np.sqrt(max(along[0], across[1])))


def test_where_a_loop_was_just_closed_no_other_is_searched() -> None:
    poses, travel = square(ROUND + 20)
    detector = ProximityDetector(CONFIG)
    detector.note_closure(closure(ROUND + 12, 12))
    assert detector.candidates(ROUND + 14, poses, travel, CERTAIN) == (), "4 m on, the same visit"
    assert detector.candidates(ROUND + 15, poses, travel, CERTAIN), "6 m on"


def test_a_loop_just_closed_with_one_visit_does_not_stop_the_search_of_another() -> None:
    poses, travel = square(2 * ROUND + 20)
    detector = ProximityDetector(CONFIG)
    detector.note_closure(closure(2 * ROUND + 12, ROUND + 12))
    targets = [candidate.target_id for candidate in detector.candidates(2 * ROUND + 13, poses, travel, CERTAIN)]
    assert targets[0] == 13
    assert all(target < ROUND - 3 for target in targets), targets


def test_a_closure_that_the_optimiser_rejected_blocks_nothing() -> None:
    poses, travel = square(ROUND + 40)
    detector = ProximityDetector(CONFIG)
    unaware = detector.candidates(ROUND + 13, poses, travel, CERTAIN)
    detector.note_closure(closure(ROUND + 12, 12))
    assert detector.candidates(ROUND + 13, poses, travel, CERTAIN) == (), "just closed"
    detector.note_estimate({(ROUND + 12, 12): 0.01})
    again = detector.candidates(ROUND + 13, poses, travel, CERTAIN)
    assert [found.target_id for found in again] == [found.target_id for found in unaware]
    detector.note_estimate({(ROUND + 12, 12): 0.9})
    assert detector.candidates(ROUND + 13, poses, travel, CERTAIN) == (), "accepted by a later optimisation"


def test_an_old_keyframe_may_be_searched_again_among_those_before_it() -> None:
    poses, travel = square(3 * ROUND)
    found = found_by(ROUND + 12, poses, travel)
    assert {candidate.target_id for candidate in found} == {12, 9, 15}


def test_moving_and_turning_the_world_changes_no_candidate() -> None:
    poses, travel = square(ROUND + 30)
    poses[:, 0, 3] += 0.01 * np.arange(len(poses))  # no two at the same distance
    T_new_world = geometry.transform(geometry.yaw(1.0), [100.0, -50.0, 7.0])
    before = found_by(ROUND + 29, poses, travel)
    after = found_by(ROUND + 29, T_new_world @ poses, travel)
    assert [candidate.target_id for candidate in before] == [candidate.target_id for candidate in after]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_allclose(old.T_target_source_prior, new.T_target_source_prior, atol=1e-9)


def test_the_first_keyframe_has_no_candidate() -> None:
    assert found_by(0, np.eye(4)[None], np.zeros(1)) == ()


def test_a_candidate_does_not_keep_the_covariances_of_all_others() -> None:
    poses, travel = square(3 * ROUND + 13)
    found = found_by(ROUND + 29, poses, travel)
    assert found
    assert all(candidate.covariance.base is None for candidate in found)
