"""Loops that the prior does not support, or that are not probable enough by themselves, wait until others confirm them.

A single registration may be wrong, because places repeat. Where the graph predicts the pose, the prior excludes such
errors; after much drift, and across a break of the odometry, nothing does, and one wrong loop ruins the map. Such a
loop, one that contradicts its prior, and one that is less probable than the user accepts, is closed only if several
keyframes, along some metres of travel, are registered, and their poses are consistent with the odometry between them.
"""

from itertools import compress

from segslam.candidates.places import SAME_PLACE_M
from segslam.core.types import LoopAttempt, LoopCandidate, LoopClosure, Rejected, RejectReason
from segslam.graph import Graph
from segslam.graph.motions import PLACE_M

MIN_CONSISTENT = 3
"""Chosen: number of registrations of keyframes that must be consistent, of more than one place."""


class Confirmation:
    """The registrations that are not yet confirmed, and their confirmation by later ones."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._waiting: list[tuple[LoopCandidate, LoopClosure]] = []

    def is_waiting(self, keyframe_id: int) -> bool:
        """True if this keyframe may confirm an earlier registration."""
        return bool(self._near(keyframe_id))

    def attempts(
        self, candidate: LoopCandidate, closure: LoopClosure, seconds: dict[str, float]
    ) -> tuple[LoopAttempt, ...]:
        """The closures of a registration and of all that confirm it; one UNCONFIRMED attempt if these are too few.

        If they confirm each other, the noise of an odometry that contradicts them is increased.
        """
        waiting = self._near(closure.source_id)
        closures = [closure, *(other for _, other in waiting)]
        consistent = list(compress(waiting, self._graph.consistent_pairs(closures)[0, 1:])) if waiting else []
        sources = {other.source_id for _, other in consistent} - {closure.source_id}
        travel_m = self._graph.travel_m
        if (
            len(sources) + 1 < MIN_CONSISTENT
            or max(abs(travel_m[closure.source_id] - travel_m[source_id]) for source_id in sources) < SAME_PLACE_M
        ):
            self._waiting.append((candidate, closure))
            shown = f"{len(sources)} of {MIN_CONSISTENT - 1} earlier keyframes confirm it"
            return (LoopAttempt(candidate, Rejected(RejectReason.UNCONFIRMED, shown), seconds),)
        self._waiting = [one for one in self._waiting if not any(one is near for near in waiting)]
        self._graph.weigh_odometry_by(closure)
        return *(LoopAttempt(*one, {}) for one in consistent), LoopAttempt(candidate, closure, seconds)

    def _near(self, keyframe_id: int) -> list[tuple[LoopCandidate, LoopClosure]]:
        travel_m = self._graph.travel_m
        return [one for one in self._waiting if abs(travel_m[keyframe_id] - travel_m[one[1].source_id]) <= PLACE_M]
