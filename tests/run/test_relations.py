"""Relative poses of drives, and the components that they make."""

from pathlib import Path

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.types import Alignment, LoopClosure, Registration, SegslamError
from segslam.run.fleets.kept import read_kept, write_kept
from segslam.run.fleets.relations import MOST_FAILED, Components, inverted
from segslam.run.sessions.session_pose import Relation

RNG = np.random.default_rng(3)


def _pose() -> np.ndarray:
    return geometry.exp(RNG.normal(size=6))


def _registration(T: np.ndarray) -> Registration:
    root = RNG.normal(size=(6, 6))
    return Registration(T, 30, 20, 0.1, root @ root.T + np.eye(6))


def _found(own: int, target: int) -> LoopClosure:
    coarse, fine = _registration(_pose()), _registration(_pose())
    return LoopClosure.of(own, target, Alignment(coarse, fine, 0.8, 0.05, 0.001, observability=0.5))


def test_a_relation_is_read_as_it_was_written(tmp_path: Path) -> None:
    file = tmp_path / "relation.json"
    relation = Relation(_pose(), (_found(3, 5), _found(7, 9)))
    write_kept(file, Relation, relation)
    again = read_kept(file, Relation)
    np.testing.assert_array_equal(again.T_earlier_later, relation.T_earlier_later)
    for found, found_again in zip(relation.found, again.found, strict=True):
        assert found.pair == found_again.pair
        own, read = found.alignment, found_again.alignment
        for one, other in ((found, found_again), (own.coarse, read.coarse), (own.fine, read.fine)):
            np.testing.assert_array_equal(one.T_target_source, other.T_target_source)
            np.testing.assert_array_equal(one.information, other.information)
        assert own.observability == read.observability
    write_kept(file, Relation, Relation(None, (), "0 of 9"))
    assert read_kept(file, Relation).reason == "0 of 9"
    file.write_text('{"found": 3}')
    with pytest.raises(SegslamError, match="damaged"):
        read_kept(file, Relation)


def test_the_inverse_has_the_same_cost_for_the_same_motion() -> None:
    """A tangent of a pose, and the tangent of the inverse that stands for the same pose, have equal chi-squares."""
    pose = _registration(_pose())
    back = inverted(LoopClosure.of(1, 0, Alignment(pose, pose, 0.8, 0.05, 0.001)))
    np.testing.assert_allclose(back.T_target_source @ pose.T_target_source, np.eye(4), atol=1e-12)
    tangent = 1e-4 * RNG.normal(size=6)
    moved = geometry.inverse(pose.T_target_source @ geometry.exp(tangent))
    tangent_back = geometry.log(geometry.inverse(back.T_target_source) @ moved)
    np.testing.assert_allclose(
        tangent_back @ back.information @ tangent_back, tangent @ pose.information @ tangent, rtol=1e-3
    )


def test_drives_that_look_like_nothing_are_a_pair_like_others() -> None:
    components = Components(3)
    assert components.next_pairs({(1, 0): 0.0, (2, 0): 0.0, (2, 1): 0.0}) == [(1, 0), (2, 0)]


def test_each_drive_is_related_to_the_most_similar_earlier_one_first() -> None:
    components = Components(5)
    similarity = {(2, 0): 9.0, (2, 1): 7.0, (3, 1): 3.0, (4, 3): 5.0}
    assert components.next_pairs(similarity) == [(2, 0), (3, 1), (4, 3)]
    T_0_2, T_1_2 = _pose(), _pose()
    components.add(2, 0, Relation(T_0_2, (_found(1, 1),)))
    components.add(2, 1, Relation(T_1_2, (_found(2, 3),)))
    components.add(4, 3, Relation(None, (), "not found"))
    (order, poses), *others = components.arranged()
    assert [alone for alone, _ in others] == [[3], [4]]
    assert components.next_pairs(similarity) == [(3, 1)]
    assert components.next_pairs({**similarity, (4, 0): 1.0}) == [(3, 1), (4, 0)]
    assert order == [0, 2, 1]
    assert poses[0] is None
    assert poses[1] is not None
    assert poses[2] is not None
    np.testing.assert_allclose(poses[1].T_earlier_world, T_0_2)
    np.testing.assert_allclose(poses[2].T_earlier_world, geometry.inverse(T_1_2))
    assert poses[2].earlier == 1, "the second of the order"
    assert poses[2].found[0].pair == (3, 2), "keyframe of the drive, and of the one before it"


def test_a_drive_that_several_earlier_ones_do_not_fit_is_not_tried_with_all() -> None:
    num_drives = 40
    components = Components(num_drives)
    similarity = {(later, earlier): 1.0 for later in range(num_drives) for earlier in range(later)}
    num_tried = 0
    while pairs := components.next_pairs(similarity):
        for pair in pairs:
            components.add(*pair, Relation(None, (), "not found"))
            num_tried += 1
    assert num_tried == sum(min(drive, MOST_FAILED) for drive in range(num_drives))


def test_a_component_that_others_do_not_fit_waits_until_a_drive_joins_it() -> None:
    first, second = 1, MOST_FAILED + 2
    components = Components(second + 1)
    similarity = {(MOST_FAILED + 1, earlier): 9.0 - earlier for earlier in range(MOST_FAILED + 1)}
    for _ in range(MOST_FAILED):
        (pair,) = components.next_pairs(similarity)
        components.add(*pair, Relation(None, (), "not found"))
    assert components.next_pairs(similarity) == []
    components.add(second, MOST_FAILED + 1, Relation(_pose(), ()))
    assert components.next_pairs(similarity) == [(MOST_FAILED + 1, MOST_FAILED)]
    assert components.next_pairs({**similarity, (second, first): 7.0}) == [(second, first)]
