"""Which keyframes of a session are searched in another."""

from segslam.run.sessions.session_pose import _with_neighbours


def test_after_a_keyframe_that_was_found_those_beside_it_are_searched() -> None:
    there = {0, 1, 2, 3, 9}
    found: list[int] = []
    searched = []
    for keyframe_id in _with_neighbours([5, 1, 9, 0], 10, lambda: found[-1] if found else None):
        searched.append(keyframe_id)
        if keyframe_id in there:
            found.append(keyframe_id)
    assert searched == [5, 1, 2, 3, 4, 0, 9, 8]
    assert set(found) == there


def test_without_a_found_keyframe_only_the_likely_ones_are_searched() -> None:
    assert list(_with_neighbours([5, 1, 5, 12], 10, lambda: None)) == [5, 1]
