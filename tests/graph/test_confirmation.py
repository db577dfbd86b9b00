from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import Config, GraphConfig
from segslam.core.types import (
    Alignment,
    LoopAttempt,
    LoopCandidate,
    LoopClosure,
    Registration,
    Rejected,
    RejectReason,
    Transform,
)
from segslam.graph import PoseGraph
from segslam.graph.confirmation import MIN_CONSISTENT, Confirmation
from segslam.graph.motions import PLACE_M

STEP_M = 2.0
NUM = 200


def drive(breaks: Sequence[int] = ()) -> PoseGraph:
    """Straight on, with unknown motions to some keyframes."""
    graph = PoseGraph(GraphConfig())
    for number in range(NUM):
        information = 1e-4 * np.eye(6) if number in breaks else None
        at_m = number * STEP_M
        graph.add_keyframe(number, geometry.transform(np.eye(3), [at_m, 0.0, 0.0]), at_m, information=information)
    return graph


STAYS: Transform = np.eye(4)
COVARIANCE = np.diag([0.01, 0.01, 0.01, 1.0, 1.0, 1.0])


def loop(
    graph: PoseGraph,
    source_id: int,
    target_id: int | None = None,
    *,
    T_drift: Transform = STAYS,
    probability: float = 0.99,
) -> tuple[LoopCandidate, LoopClosure]:
    """A loop from this keyframe, by default to one of the first; by default, it agrees with the odometry."""
    target_id = max(source_id - 185, 0) if target_id is None else target_id
    T_prior = geometry.inverse(graph.T_world_keyframes[target_id]) @ graph.T_world_keyframes[source_id]
    T_target_source = (
        geometry.inverse(graph.T_world_keyframes[target_id]) @ T_drift @ graph.T_world_keyframes[source_id]
    )
    registration = Registration(T_target_source, 20, 20, 0.1, np.eye(6) * 1e4)
    alignment = Alignment(registration, registration, 0.9, 0.1, 0.0, probability=probability)
    closure = LoopClosure.of(source_id, target_id, alignment)
    return LoopCandidate(source_id, target_id, T_prior, 0.0, COVARIANCE), closure


def attempts(confirmation: Confirmation, graph: PoseGraph, *pair: int, **kind: Any) -> Sequence[LoopAttempt]:
    """What becomes of such a loop."""
    return confirmation.attempts(*loop(graph, *pair, **kind), {})


def refuse(confirmation: Confirmation, source_id: int, target_id: int, *, probability: float = 0.001) -> None:
    """Note that the best pose between these two was not probable enough."""
    candidate = LoopCandidate(source_id, target_id, np.eye(4), 0.0)
    confirmation.note(LoopAttempt(candidate, Rejected(RejectReason.AMBIGUOUS, "", probability=probability), {}))


def are_closed(found: Sequence[LoopAttempt]) -> bool:
    return all(isinstance(one.outcome, LoopClosure) for one in found)


def test_registrations_wait_for_others_that_are_near() -> None:
    graph = drive()
    confirmation = Confirmation(graph, Config())
    sources = [190, 194, 197]
    for source_id in sources[:-1]:
        assert not are_closed(attempts(confirmation, graph, source_id))
    assert not confirmation.is_waiting(10), "it is farther than PLACE_M"
    found = attempts(confirmation, graph, sources[-1])
    assert are_closed(found), "a search that begins with the first keyframes again drops none"
    assert len(found) == MIN_CONSISTENT
    assert not confirmation.is_waiting(sources[-1]), "they are closed"


@pytest.mark.parametrize(
    ("targets", "breaks", "are_confirmed"),
    [((5, 9, 12), [100], True), ((5, 5, 5), [100], False), ((5, 6, 5), [100], False), ((5, 5, 5), [], True)],
)
def test_loops_to_one_place_do_not_confirm_each_other_across_a_break(
    targets: tuple[int, ...], breaks: list[int], are_confirmed: bool
) -> None:
    graph = drive(breaks)
    confirmation = Confirmation(graph, Config())
    for source_id, target_id in zip((190, 194, 197), targets, strict=True):
        found = attempts(confirmation, graph, source_id, target_id)
    assert are_closed(found) is are_confirmed


def test_loops_do_not_confirm_each_other_across_a_break_of_the_earlier_pass() -> None:
    graph = drive(breaks=[11])
    confirmation = Confirmation(graph, Config())
    for source_id in (190, 194, 197, 198):
        assert not are_closed(attempts(confirmation, graph, source_id))
    assert are_closed(attempts(confirmation, graph, 199)), "three loops lead to the part after the break"


def test_a_confirmation_leaves_those_that_wait_elsewhere() -> None:
    graph = drive()
    confirmation = Confirmation(graph, Config())
    far_id = 197 - int(2 * PLACE_M / STEP_M)
    attempts(confirmation, graph, far_id)
    for source_id in (190, 194, 197):
        found = attempts(confirmation, graph, source_id)
    assert {one.candidate.source_id for one in found} == {190, 194, 197}
    assert confirmation.is_waiting(far_id)


BACK_M = -(190 - 5) * STEP_M
"""With this drift along the drive, keyframe 190 is where keyframe 5 is."""
DRIFT: Transform = geometry.transform(np.eye(3), [BACK_M, 0.0, 0.0])


@pytest.mark.parametrize(("probability", "are_probable"), [(0.99, True), (0.9, False)])
def test_loops_that_agree_are_closed_if_together_they_are_probable(probability: float, are_probable: bool) -> None:
    graph = drive()
    confirmation = Confirmation(graph, Config())
    for source_id in (190, 194, 197):
        found = attempts(confirmation, graph, source_id, probability=probability)
    assert are_closed(found) is are_probable
    outcome = found[-1].outcome
    assert are_probable or (isinstance(outcome, Rejected) and "contradict" in outcome.detail)


@pytest.mark.parametrize(("target_id", "num_refused", "are_probable"), [(5, 0, True), (5, 12, False), (60, 12, True)])
def test_refused_attempts_count_against_loops_with_which_their_keyframes_are_near_each_other(
    target_id: int, num_refused: int, are_probable: bool
) -> None:
    graph = drive()
    confirmation = Confirmation(graph, Config())
    for number in range(num_refused):
        refuse(confirmation, 190 + number % 3, target_id + number // 6)
    for source_id in (190, 192, 193):
        found = attempts(confirmation, graph, source_id, T_drift=DRIFT, probability=0.9995)
    assert are_closed(found) is are_probable


@pytest.mark.parametrize(("first_id", "are_probable"), [(100, True), (182, False)])
def test_refused_attempts_count_within_a_stretch_of_the_drive(first_id: int, are_probable: bool) -> None:
    graph = drive()
    confirmation = Confirmation(graph, Config())
    for number in range(12):
        refuse(confirmation, first_id + number, first_id + number - 2)
    for source_id in (190, 192, 193):
        found = attempts(confirmation, graph, source_id)
    assert are_closed(found) is are_probable


def test_refused_attempts_never_count_for_loops() -> None:
    graph = drive()
    confirmation = Confirmation(graph, Config())
    for number in range(12):
        refuse(confirmation, 190 + number % 3, 5 + number // 6, probability=0.8)
    for source_id in (190, 192, 193):
        found = attempts(confirmation, graph, source_id, T_drift=DRIFT, probability=0.95)
    assert not are_closed(found)


def test_loops_that_lead_elsewhere_count_against_others_nearby() -> None:
    elsewhere: Transform = geometry.transform(np.eye(3), [BACK_M + 25.0, 0.0, 0.0])
    closed = []
    for num_elsewhere in (0, 6):
        graph = drive()
        confirmation = Confirmation(graph, Config())
        for number in range(num_elsewhere):
            attempts(confirmation, graph, 187 + number // 3, T_drift=elsewhere)
        for source_id in (190, 192, 193):
            found = attempts(confirmation, graph, source_id, T_drift=DRIFT, probability=0.9995)
        closed.append(are_closed(found))
    assert closed == [True, False]


def test_loops_that_contradict_the_odometry_must_be_more_probable() -> None:
    turned: Transform = geometry.transform(geometry.yaw(np.pi), [0.0, 0.0, 0.0])
    graph = drive()
    confirmation = Confirmation(graph, Config())
    T_drift: Transform = graph.T_world_keyframes[5] @ turned @ geometry.inverse(graph.T_world_keyframes[190])
    for source_id in (190, 192, 193):
        found = attempts(confirmation, graph, source_id, T_drift=T_drift, probability=0.98)
    assert not are_closed(found)


@pytest.mark.parametrize(("source_id", "are_probable"), [(188, False), (150, True)])
def test_loops_that_were_closed_nearby_count_against_others_that_contradict_them(
    source_id: int, are_probable: bool
) -> None:
    graph = drive()
    confirmation = Confirmation(graph, Config())
    confirmation.note(LoopAttempt(*loop(graph, source_id), {}))
    for later_id in (190, 192, 193):
        found = attempts(confirmation, graph, later_id, T_drift=DRIFT, probability=0.9995)
    assert are_closed(found) is are_probable
