"""Where a session meets another: keyframes of one found in the other with no guess, and the largest consistent set.

Consistent means that two found places and the odometry between them, in either session, close a loop within their
noise (`segslam.pose_graph.consistency`). A place found wrong is consistent with few others.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from segslam import geometry
from segslam.config import Config
from segslam.pose_graph import PoseGraph
from segslam.proximity import BREAK_TRAVEL_M
from segslam.run.locator import Locator
from segslam.sessions.recorded import UNTIED, Session, submaps
from segslam.types import Alignment, LoopAttempt, LoopCandidate, LoopClosure, Rejected, Transform

NUM_QUERIES = 60
"""Chosen: keyframes of a session that are looked for in another, spread over its travel."""
NUM_ENOUGH = 12
"""Chosen: no more are looked for when so many are found; further loops are found by proximity."""
MIN_FOUND = 3
"""Chosen: so many places that are consistent make a meeting."""
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
MIN_SPREAD_M = 10.0
"""Chosen: if they lie within less travel, they are one look at one place, which may be wrong."""

Shown = Callable[[Iterable[Any], int, str], Iterator[Any]]
"""Shows the progress of some work: the items, how many there are, and a title."""


def not_shown(items: Iterable[Any], total: int, title: str) -> Iterator[Any]:
    """Work whose progress nobody watches."""
    return iter(items)


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """How a session lies in an earlier one."""

    earlier: int
    """Number of the earlier session."""
    T_earlier_world: Transform
    """The session's world in that of the earlier one."""
    found: tuple[tuple[int, int, Alignment], ...]
    """Keyframe of the session, keyframe of the earlier one, and their alignment, of the consistent places."""


def meeting(
    session: Session,
    earlier: Session,
    number: int,
    locator: Locator,
    *,
    config: Config,
    shown: Shown = not_shown,
) -> Meeting | str:
    """How a session lies in an earlier one, the session of this `number`; or, in words, why it is not known.

    Thin keyframes are looked for together with their neighbours.
    """
    submap = submaps(session, config)
    found: list[tuple[int, int, Alignment]] = []
    queries = _spread(len(session.travel_m))
    num_tried = 0
    for keyframe_id in shown(queries, len(queries), "locate"):
        num_tried += 1
        place = locator.locate(*submap(keyframe_id))
        if not isinstance(place, Rejected):
            found.append((keyframe_id, place.keyframe_id, place.alignment))
        if len(found) == NUM_ENOUGH:
            break
    summary = f"{len(found)} of {num_tried} keyframes were found there"
    if len(found) < MIN_FOUND:
        return f"{summary}, and {MIN_FOUND} are needed"
    graph, first_id = _both(earlier, session, config)
    closures = [closure(one, first_id) for one in found]
    consistent = graph.consistent(closures)
    kept = [one for one, keep in zip(found, consistent, strict=True) if keep]
    travel_m = session.travel_m[[one[0] for one in kept]]
    if len(kept) < MIN_FOUND or np.ptp(travel_m) < MIN_SPREAD_M:
        return f"{summary}, but no {MIN_FOUND} of them, {MIN_SPREAD_M:g} m apart, are consistent with the odometry"
    for one, keep in zip(closures, consistent, strict=True):
        if keep:
            graph.add_closure(one)
    graph.optimize()
    T_earlier_first = graph.T_world_keyframes[first_id]
    return Meeting(number, T_earlier_first @ geometry.inverse(session.T_world_keyframe[0]), tuple(kept))


def _spread(num_keyframes: int) -> list[int]:
    """Keyframes spread over a session, each far from those before it."""
    evenly = np.unique(np.linspace(0, num_keyframes - 1, NUM_QUERIES).astype(int))
    return evenly[np.argsort(np.arange(len(evenly)) * GOLDEN % 1.0)].tolist()


def closure(found: tuple[int, int, Alignment], first_id: int, target_shift: int = 0) -> LoopClosure:
    """A found place as a loop of a graph in which the session's keyframes begin at `first_id`."""
    own, target, alignment = found
    fine = alignment.fine
    return LoopClosure(own + first_id, target + target_shift, fine.T_target_source, fine.information, alignment)


def attempt(found: tuple[int, int, Alignment], first_id: int, target_shift: int) -> LoopAttempt:
    """The same as an attempt: its prior is what was found."""
    made = closure(found, first_id, target_shift)
    T_target_source = made.T_target_source
    distance_m = geometry.distance(T_target_source)
    candidate = LoopCandidate(made.source_id, made.target_id, T_target_source, distance_m, distance_m, BREAK_TRAVEL_M)
    return LoopAttempt(candidate, made, {})


def _both(earlier: Session, session: Session, config: Config) -> tuple[PoseGraph, int]:
    """A graph of the keyframes of two sessions, each as its own run estimates them; and the first id of the second."""
    graph = PoseGraph(config.graph)
    first_id = len(earlier.travel_m)
    add = partial(_add, graph)
    for number, one in enumerate((earlier, session)):
        shift_m = number * (float(earlier.travel_m[-1]) + BREAK_TRAVEL_M)
        for row, (T_world, travel_m) in enumerate(zip(one.T_world_keyframe, one.travel_m, strict=True)):
            information = UNTIED.information if number and row == 0 else one.informations[row]
            add(T_world, float(travel_m) + shift_m, information)
    return graph, first_id


def _add(graph: PoseGraph, T_world_keyframe: Transform, travel_m: float, information: Any) -> None:
    graph.add_keyframe(graph.num_keyframes, T_world_keyframe, travel_m, information=information)
