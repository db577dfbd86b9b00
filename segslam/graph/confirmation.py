"""Loops that the prior does not support, or that are not probable enough by themselves, wait until others confirm them.

A single registration may be wrong, because places repeat. Where the graph predicts the pose, the prior excludes such
errors; after much drift, and across a break of the odometry, nothing does, and one wrong loop ruins the map. Such a
loop, one that contradicts its prior, and one that is less probable than the user accepts, is closed only if several
keyframes, along some metres of travel, are registered, and their poses are consistent with the odometry between them.
"""

from dataclasses import dataclass

from segslam.core.types import LoopAttempt, LoopCandidate, LoopClosure, Rejected, RejectReason
from segslam.graph import Graph

MIN_CONSISTENT, MIN_SPREAD_M = 3, 5.0
"""Chosen: number of keyframes that must be consistent, and travel between the first and the last."""
WAITING_M = 40.0
"""Chosen: travel after which an unconfirmed registration is dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Unconfirmed:
    """A registration that is not yet confirmed by others."""

    closure: LoopClosure
    candidate: LoopCandidate


class Confirmation:
    """The registrations that are not yet confirmed, and their confirmation by later ones."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._waiting: list[Unconfirmed] = []

    def is_waiting(self, keyframe_id: int) -> bool:
        """True if this keyframe may confirm an earlier registration."""
        at_m = self._graph.travel_m[keyframe_id]
        self._waiting = [one for one in self._waiting if abs(at_m - self._travel_m(one)) <= WAITING_M]
        return bool(self._waiting)

    def attempts(
        self, candidate: LoopCandidate, closure: LoopClosure, seconds: dict[str, float]
    ) -> tuple[LoopAttempt, ...]:
        """The closures of a registration and of all that confirm it; one UNCONFIRMED attempt if these are too few.

        If they confirm each other, the noise of an odometry that contradicts them is increased.
        """
        newest = Unconfirmed(closure, candidate)
        waiting = self._waiting if self.is_waiting(closure.source_id) else []
        is_consistent = self._graph.consistent_with(closure, [one.closure for one in waiting]) if waiting else ()
        consistent = [one for one, keep in zip(waiting, is_consistent, strict=True) if keep]
        sources = {one.closure.source_id for one in consistent} - {closure.source_id}
        if (
            len(sources) + 1 < MIN_CONSISTENT
            or max(abs(self._travel_m(newest) - self._travel_m(one)) for one in consistent) < MIN_SPREAD_M
        ):
            self._waiting.append(newest)
            shown = f"{len(sources)} of {MIN_CONSISTENT - 1} earlier keyframes confirm it"
            return (LoopAttempt(candidate, Rejected(RejectReason.UNCONFIRMED, shown), seconds),)
        self._waiting = []
        self._graph.weigh_odometry_by(closure)
        return (
            *(LoopAttempt(one.candidate, one.closure, {}) for one in consistent),
            LoopAttempt(candidate, closure, seconds),
        )

    def _travel_m(self, one: Unconfirmed) -> float:
        return float(self._graph.travel_m[one.closure.source_id])
