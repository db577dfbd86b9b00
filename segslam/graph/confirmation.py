"""Loops that the prior does not support, or that are not probable enough by themselves, wait until others confirm them.

A single registration may be wrong, because places repeat. Where the graph predicts the pose, the prior excludes such
errors; after much drift, and across a break of the odometry, nothing does, and one wrong loop ruins the map. Such a
loop, one that contradicts its prior, and one that is less probable than the user accepts, is closed only if several
keyframes, along some metres of travel, are registered, their poses are consistent with the odometry between them, and
all attempts there together make them probable: also those that were refused, and those that lead elsewhere. Across a
break the earlier keyframes are along some metres, too: otherwise all loops may have the error of one scan.
"""

import math
from collections.abc import Sequence
from itertools import compress

import numpy as np

from segslam.candidates.places import SAME_PLACE_M
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.probabilities import log_chance, log_odds
from segslam.core.types import LoopAttempt, LoopCandidate, LoopClosure, Mask, Rejected, RejectReason
from segslam.graph import PoseGraph
from segslam.graph.motions import PLACE_M
from segslam.verification.score import MISLED, log_odds_of_all

MIN_CONSISTENT = 3
"""Chosen: number of registrations of keyframes that must be consistent, of more than one place."""
SHARES = (np.arange(50) + 0.5) / 50
"""Shares of pairs that a registration finds at the right pose; all are as probable, because each sensor has its own."""

Attempted = tuple[LoopCandidate, LoopClosure]


class Confirmation:
    """The registrations that are not yet confirmed, and their confirmation by later ones."""

    def __init__(self, graph: PoseGraph, config: Config) -> None:
        self._graph = graph
        self._radius_m = config.proximity.base_radius_m
        self._least_odds = log_odds_of_all(config.verify)
        self._waiting: list[Attempted] = []
        self._refused: list[tuple[tuple[int, int], float]] = []
        """Pairs whose best pose was not probable enough, and its log odds; a probable one may lead elsewhere."""
        self._closed: list[LoopClosure] = []

    def is_waiting(self, keyframe_id: int) -> bool:
        """True if this keyframe may confirm an earlier registration."""
        return bool(self._near(keyframe_id))

    def note(self, attempt: LoopAttempt) -> None:
        """Note an attempt, which is evidence for or against the loops nearby that wait."""
        outcome = attempt.outcome
        if isinstance(outcome, LoopClosure):
            self._closed.append(outcome)
        elif outcome.probability is not None:
            self._refused.append((attempt.candidate.pair, min(log_odds(outcome.probability), 0.0)))

    def attempts(
        self, candidate: LoopCandidate, closure: LoopClosure, seconds: dict[str, float]
    ) -> tuple[LoopAttempt, ...]:
        """The closures of a registration and of all that confirm it; one UNCONFIRMED attempt if these are too few.

        If they confirm each other, the noise of an odometry that contradicts them is increased.
        """
        part = self._graph.num_breaks  # across a break, any two loops are consistent
        near = self._near(closure.source_id)
        waiting = [one for one in near if part[one[1].target_id] == part[closure.target_id]]
        agreeing = list(compress(waiting, self._are_consistent(closure, [other for _, other in waiting])))
        ends = np.array([(one.source_id, one.target_id) for one in (closure, *(other for _, other in agreeing))])
        num = len(np.unique(ends[:, 0]))
        if part[closure.source_id] == part[closure.target_id]:  # else only the loops show where the targets are
            ends = ends[:, :1]
        if num < MIN_CONSISTENT or np.ptp(self._graph.travel_m[ends], axis=0).min() < SAME_PLACE_M:
            lacking = f"{num - 1} of {MIN_CONSISTENT - 1} earlier keyframes confirm it"
        else:
            together = self._log_odds(candidate, closure, [other for _, other in agreeing])
            lacking = f"other attempts contradict it: log odds {together:.1f}" if together < self._least_odds else ""
        if lacking:
            self._waiting.append((candidate, closure))
            return (LoopAttempt(candidate, Rejected(RejectReason.UNCONFIRMED, lacking), seconds),)
        self._waiting = [one for one in self._waiting if not any(one is near for near in waiting)]
        self._graph.weigh_odometry_by(closure)
        return *(LoopAttempt(*one, {}) for one in agreeing), LoopAttempt(candidate, closure, seconds)

    def _log_odds(self, candidate: LoopCandidate, closure: LoopClosure, agreeing: Sequence[LoopClosure]) -> float:
        """That the drift which these loops agree on is right, by the odometry and by all attempts nearby.

        An attempt between keyframes that this drift brings near each other has found the right pose, which is as
        probable as its odds, or, in a share of all that is unknown, has failed. A loop that was closed and is not
        consistent with the drift is misleading if this is right.
        """
        off = geometry.log(geometry.inverse(candidate.T_target_source_prior) @ closure.T_target_source)
        prior = log_chance(float(off @ np.linalg.pinv(candidate.covariance) @ off), len(off))
        closed = [one for one in self._closed if self._is_near(one.source_id, closure.source_id)]
        against = math.log(MISLED) * float(np.sum(~self._are_consistent(closure, closed)))
        probabilities = [one.alignment.probability for one in (closure, *agreeing)]  # None by logs of older versions
        odds = [min(log_odds(1.0 if each is None else each), -math.log(MISLED)) for each in probabilities]
        odds += self._elsewhere(closure, {one.pair for one in (closure, *agreeing)})
        found = np.logaddexp(np.log(SHARES)[:, None] + odds, np.log1p(-SHARES)[:, None]).sum(axis=1)
        return prior + against + float(np.logaddexp.reduce(found)) - math.log(len(SHARES))

    def _elsewhere(self, closure: LoopClosure, agreeing: set[tuple[int, int]]) -> list[float]:
        """Log odds of other attempts nearby between keyframes that are near each other with the drift of a loop."""
        T_world = self._graph.T_world_keyframes
        T_moved = T_world[closure.target_id] @ closure.T_target_source @ geometry.inverse(T_world[closure.source_id])
        waiting = [(one.pair, -math.inf) for _, one in self._waiting]
        return [
            odds
            for (source_id, target_id), odds in (*waiting, *self._refused)
            if (source_id, target_id) not in agreeing
            and self._is_near(source_id, closure.source_id)
            and np.hypot(*((T_moved @ T_world[source_id]) - T_world[target_id])[:2, 3]) < self._radius_m
        ]

    def _are_consistent(self, closure: LoopClosure, others: Sequence[LoopClosure]) -> Mask:
        """(k,) which other loops are consistent with one."""
        return self._graph.consistent_pairs([closure, *others])[0, 1:]

    def _near(self, keyframe_id: int) -> list[Attempted]:
        return [one for one in self._waiting if self._is_near(keyframe_id, one[1].source_id)]

    def _is_near(self, keyframe_id: int, other_id: int) -> bool:
        travel_m = self._graph.travel_m
        return bool(abs(travel_m[keyframe_id] - travel_m[other_id]) <= PLACE_M)
