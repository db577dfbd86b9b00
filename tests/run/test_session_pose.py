"""Which keyframes of a session are searched in another, and which of those found are evidence for its pose."""

from collections import deque
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import Alignment, Registration
from segslam.run.locator import Located, Locator
from segslam.run.sessions import session_pose
from segslam.run.sessions.recorded import Session
from segslam.run.sessions.session_pose import each_once, find_session

NUM, STEP_M = 40, 2.0


def straight(break_at: int | None = None) -> Any:
    """A session of keyframes straight on, with an unknown motion to one of them."""
    at_m = STEP_M * np.arange(NUM)
    informations = [1e-4 * np.eye(6) if number == break_at else None for number in range(NUM)]
    result = SimpleNamespace(keyframe_informations=lambda: list(informations))
    poses = np.array([geometry.transform(np.eye(3), [x, 0.0, 0.0]) for x in at_m])
    return Mock(spec=Session, travel_m=at_m, T_world_keyframe=poses, run=SimpleNamespace(result=result))


@pytest.mark.parametrize(("break_at", "is_found"), [(None, True), (20, False), (10, True)])
def test_keyframes_on_both_sides_of_a_break_are_no_evidence_for_each_other(
    break_at: int | None, is_found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        session_pose, "submaps_of", lambda *_: SimpleNamespace(submap=lambda k: SimpleNamespace(points=k, labels=None))
    )

    def locate(keyframe_id: int, *_: Any, **__: Any) -> Located:
        """At the keyframe of the same number, 1 m to its left."""
        T_target_source = geometry.transform(np.eye(3), [0.0, 1.0, 0.0])
        registration = Registration(T_target_source, 20, 20, 0.1, np.eye(6) * 1e4)
        return Located(np.eye(4), keyframe_id, Alignment(registration, registration, 0.9, 0.1, 0.0), 0.0)

    locator = Mock(spec=Locator, session=straight(), locate=locate)
    monkeypatch.setattr(session_pose, "_spread", lambda _: [12, 15, 25, 28])
    relation = find_session(straight(break_at), locator, config=Config())
    assert (relation.T_earlier_later is not None) is is_found
    if relation.T_earlier_later is not None:
        np.testing.assert_allclose(relation.T_earlier_later[:3, 3], [0.0, 1.0, 0.0], atol=0.05)


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
