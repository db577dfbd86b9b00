"""Relative pose of two sessions: keyframes of one are located in the other, and the largest consistent set is used.

Two located keyframes are consistent if they and the odometry between them, in both sessions and without a break, form
a loop within the noise (`segslam.graph.closure_pairs`). A wrong location is consistent with few others.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from segslam.candidates.places import OTHER_PLACE_M
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.processes import Progress, no_progress
from segslam.core.types import LoopAttempt, LoopCandidate, LoopClosure, Rejected, Transform
from segslam.graph import PoseGraph
from segslam.graph.closure_pairs import largest_consistent
from segslam.graph.confirmation import MIN_CONSISTENT
from segslam.run.locator import Locator, submaps_of
from segslam.run.sessions.recorded import FIRST_MOTION, Session, shifted
from segslam.slam.recognition import MAX_PLACES

NUM_QUERIES = 60
"""Chosen: number of keyframes of a session that are searched in another, spread over its travel."""
MOST_FAILED = 4
"""Chosen on two fleets: the search for the pose of a session ends when so many of its likely keyframes, the first ones,
were not found; in each of 16 pairs of drives that share places the first was, at the place that it looks like most."""
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
"""Golden ratio less 1: steps of it, modulo 1, are spread evenly at any number."""


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """The pose of a session's world frame in that of an earlier session, or why it is unknown."""

    T_earlier_later: Transform | None
    found: tuple[LoopClosure, ...]
    """As those of `SessionPose`."""
    reason: str = ""


def find_session(
    session: Session,
    locator: Locator,
    *,
    config: Config,
    likely: Sequence[int] | None = None,
    progress: Progress = no_progress,
) -> Relation:
    """The pose of a session in an earlier one, that of the locator.

    Keyframes are searched until `MIN_CONSISTENT` consistent ones, `OTHER_PLACE_M` apart, are found: at most
    `NUM_QUERIES`, spread over the session; sparse ones together with their neighbours. `likely`: these keyframes are
    searched instead, in this order, and those before and after each that is found, until the first `MOST_FAILED` were
    not. They look like a place of the earlier session, and no other place is tried.
    """
    count = len(session.travel_m)
    submaps = submaps_of(session, config)
    graph, first_id = _both(locator.session, session, config)
    queue = deque(_spread(count) if likely is None else likely)
    found: list[LoopClosure] = []
    kept: list[LoopClosure] = []
    num_tried = 0
    for keyframe_id in progress(each_once(queue, count), min(count, len(queue)), "locate"):
        num_tried += 1
        submap = submaps.submap(keyframe_id)
        place = locator.locate(submap.points, submap.labels, max_places=MAX_PLACES if likely is None else 1)
        if not isinstance(place, Rejected):
            found.append(LoopClosure.of(keyframe_id, place.keyframe_id, place.alignment))
            if likely is not None:  # a place that is shared is so for some metres, perhaps for a few keyframes only
                queue.extendleft((keyframe_id - 1, keyframe_id + 1))
            consistent = largest_consistent(graph.agreeing_pairs([shifted(one, first_id, 0) for one in found]))
            kept = [one for one, keep in zip(found, consistent, strict=True) if keep]
        if _is_enough(kept, session) or (likely is not None and not found and num_tried == MOST_FAILED):
            queue.clear()
    if not _is_enough(kept, session):
        why = f"{MIN_CONSISTENT} are needed"
        if len(kept) >= MIN_CONSISTENT:
            why = f"but all within {OTHER_PLACE_M:g} m of its drive: too short a way is shared"
        elif len(found) >= MIN_CONSISTENT:
            why = f"but no {MIN_CONSISTENT} of them are consistent with the odometry"
        return Relation(None, (), f"{len(found)} of {num_tried} keyframes were found there, {why}")
    for one in kept:
        graph.add_closure(shifted(one, first_id, 0))
    graph.optimize()
    T_earlier_first = graph.T_world_keyframes[first_id]
    return Relation(T_earlier_first @ geometry.inverse(session.T_world_keyframe[0]), tuple(kept))


def _is_enough(kept: Sequence[LoopClosure], session: Session) -> bool:
    """True if consistent locations of keyframes determine the pose of their session."""
    travel_m = session.travel_m[[one.source_id for one in kept]]
    return len(kept) >= MIN_CONSISTENT and bool(np.ptp(travel_m) >= OTHER_PLACE_M)


def _spread(count: int) -> list[int]:
    """Keyframes spread over a session of so many, each far from the previous ones."""
    evenly = np.unique(np.linspace(0, count - 1, NUM_QUERIES).astype(int))
    keyframe_ids: list[int] = evenly[np.argsort(np.arange(len(evenly)) * GOLDEN % 1.0)].tolist()
    return keyframe_ids


def each_once(queue: deque[int], count: int) -> Iterator[int]:
    """Keyframes of a session of so many from a queue, to which others may be added meanwhile; each once."""
    searched = set[int]()
    while queue:
        keyframe_id = queue.popleft()
        if keyframe_id not in searched and 0 <= keyframe_id < count:
            searched.add(keyframe_id)
            yield keyframe_id


def attempt(closure: LoopClosure) -> LoopAttempt:
    """A located keyframe as an attempt, whose prior is the found pose."""
    T_target_source = closure.T_target_source
    candidate = LoopCandidate(*closure.pair, T_target_source, geometry.distance(T_target_source))
    return LoopAttempt(candidate, closure, {})


def _both(earlier: Session, session: Session, config: Config) -> tuple[PoseGraph, int]:
    """A graph of the keyframes of two sessions, each with the estimate of its run; and the first id of the second."""
    graph = PoseGraph(config.graph)
    first_id = len(earlier.travel_m)
    for number, one in enumerate((earlier, session)):
        shift_m = number * float(earlier.travel_m[-1])
        informations = one.run.result.keyframe_informations()
        if number:
            informations[0] = FIRST_MOTION.information
        for T_world, travel_m, information in zip(one.T_world_keyframe, one.travel_m, informations, strict=True):
            graph.add_keyframe(graph.num_keyframes, T_world, float(travel_m) + shift_m, information=information)
    return graph, first_id
