from collections.abc import Sequence

import numpy as np

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.core.types import Alignment, LoopAttempt, LoopCandidate, LoopClosure, Registration
from segslam.graph import PoseGraph
from segslam.graph.confirmation import MIN_CONSISTENT, Confirmation
from segslam.graph.motions import PLACE_M

STEP_M = 2.0
NUM = 200


def drive() -> PoseGraph:
    """Straight on."""
    graph = PoseGraph(GraphConfig())
    for number in range(NUM):
        graph.add_keyframe(number, geometry.transform(np.eye(3), [number * STEP_M, 0.0, 0.0]), number * STEP_M)
    return graph


def attempts(confirmation: Confirmation, graph: PoseGraph, source_id: int) -> Sequence[LoopAttempt]:
    """A loop that agrees with the odometry, from this keyframe to one of the first."""
    T_target_source = geometry.inverse(graph.T_world_keyframes[5]) @ graph.T_world_keyframes[source_id]
    registration = Registration(T_target_source, 20, 20, 0.1, np.eye(6) * 1e4)
    closure = LoopClosure.of(source_id, 5, Alignment(registration, registration, 0.9, 0.1, 0.0))
    return confirmation.attempts(LoopCandidate(source_id, 5, T_target_source, 0.0), closure, {})


def are_closed(found: Sequence[LoopAttempt]) -> bool:
    return all(isinstance(one.outcome, LoopClosure) for one in found)


def test_registrations_wait_for_others_that_are_near() -> None:
    graph = drive()
    confirmation = Confirmation(graph)
    sources = [190, 194, 197]
    for source_id in sources[:-1]:
        assert not are_closed(attempts(confirmation, graph, source_id))
    assert not confirmation.is_waiting(10), "it is farther than PLACE_M"
    found = attempts(confirmation, graph, sources[-1])
    assert are_closed(found), "a search that begins with the first keyframes again drops none"
    assert len(found) == MIN_CONSISTENT
    assert not confirmation.is_waiting(sources[-1]), "they are closed"


def test_a_confirmation_leaves_those_that_wait_elsewhere() -> None:
    graph = drive()
    confirmation = Confirmation(graph)
    far_id = 197 - int(2 * PLACE_M / STEP_M)
    attempts(confirmation, graph, far_id)
    for source_id in (190, 194, 197):
        found = attempts(confirmation, graph, source_id)
    assert {one.candidate.source_id for one in found} == {190, 194, 197}
    assert confirmation.is_waiting(far_id)
