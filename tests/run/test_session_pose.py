"""Which keyframes of a session are searched in another."""

from collections import deque

from segslam.run.sessions.session_pose import each_once


def test_keyframes_that_are_added_meanwhile_are_searched_next() -> None:
    queue, there = deque([5, 1, 9, 0]), {0, 1, 2, 3, 9}
    searched = []
    for keyframe_id in each_once(queue, 10):
        searched.append(keyframe_id)
        if keyframe_id in there:
            queue.extendleft((keyframe_id - 1, keyframe_id + 1))
    assert searched == [5, 1, 2, 3, 4, 0, 9, 8]


def test_keyframes_are_searched_once_and_those_that_do_not_exist_never() -> None:
    assert list(each_once(deque([5, 1, 5, 12]), 10)) == [5, 1]
