"""Loop closing: candidates for each keyframe are registered and verified; a second search uses the final poses."""

import math
from collections.abc import Iterator
from functools import lru_cache
from time import monotonic

from segslam.candidates import PlaceSignature
from segslam.candidates.proximity import LEAST_PROBABILITY, ProximityDetector
from segslam.core.config import Config
from segslam.core.threads import Stopwatch, at_once
from segslam.core.types import (
    Alignment,
    CloudOf,
    LoopAttempt,
    LoopCandidate,
    LoopClosure,
    Rejected,
    RejectReason,
    Transform,
)
from segslam.graph import PoseGraph
from segslam.graph.chains import far_from_prior, prior_gate
from segslam.graph.confirmation import Confirmation
from segslam.keyframes import Submaps
from segslam.registration.prepared import Labeller
from segslam.slam.far_loops import FarLoops
from segslam.slam.loop_edits import LoopEdits
from segslam.verification import register_near, register_prepared
from segslam.verification.score import MISLED
from segslam.verification.trial import anywhere, forget_scans

NUM_PREPARED = 32
"""Number of prepared keyframes in memory, about 1 to 2 MB each; preparing another takes about 40 ms. On KITTI 00 whole
212 are prepared, of 204 that are tried."""
ROUNDS = 3
"""Chosen: largest number of searches after the final optimisation; they end with the first that finds no loop."""
MOST_AGAIN = 0.5
"""Chosen: number of attempts in such a search, as a share of all earlier attempts; limits its time."""
LEAST_AGAIN = 40


class LoopCloser:
    """Proposes loops from the poses of the graph, and adds the verified ones to the graph."""

    def __init__(
        self, config: Config, graph: PoseGraph, clouds: CloudOf, labeller: Labeller, edits: LoopEdits, *, is_known: bool
    ) -> None:
        """`clouds` provides the points of keyframes; `labeller` computes geometric labels of gathered clouds.

        If the relative poses of several drives are known, each adjusted on its own, loops are refined from the estimate
        first.
        """
        self._edits = edits
        self._is_known = is_known
        self._config = config
        self._graph = graph
        self.detector = ProximityDetector(config.proximity)
        self.submaps = Submaps(config, clouds, labeller, lambda: graph.motion_variance)
        self._prepared = lru_cache(NUM_PREPARED)(self.submaps.prepared)
        self._observed = lru_cache(NUM_PREPARED)(self.submaps.observed)
        self._confirmation = Confirmation(graph, config)
        self._far = FarLoops(config, graph, self._prepared, self._confirmation, edits.forbidden)
        self._tried: set[tuple[int, int]] = set(edits.forbidden)
        self._unsearched: set[int] = set()
        """Keyframes for which no loop was searched when they were added, because the machine was too slow."""

    def add(
        self, T_odom_keyframe: Transform, *, labelled_by_shape: bool, recorded: bytes | None = None
    ) -> PlaceSignature | None:
        """Add the newest keyframe, which graph and clouds contain already; returns the signature of its place.

        `recorded`: this signature, if it is known from a log.
        """
        newest_id = len(self.submaps.T_odom)
        self._unsearched.add(newest_id)
        self.submaps.add(T_odom_keyframe, labelled_by_shape=labelled_by_shape)
        if not self._config.retrieval.enabled:
            return None
        signature = self.submaps.signature(newest_id, recorded)
        self._far.add(newest_id, signature)
        return signature

    def forget(self) -> None:
        """Release the prepared keyframes; they are prepared again when they are needed."""
        self._prepared.cache_clear()
        self._observed.cache_clear()
        forget_scans()

    def attempt(self, keyframe_id: int, watch: Stopwatch, *, below: int | None = None) -> tuple[LoopAttempt, ...]:
        """Propose and try loops for a keyframe; with `below`, only with smaller ids, those of earlier sessions."""
        with watch("propose"):
            candidates = self.detector.candidates(
                keyframe_id, self._graph.T_world_keyframes, self._graph.travel_m, self._graph.covariances, below=below
            )
        added = sorted(older_id for newer_id, older_id in self._edits.added if newer_id == keyframe_id)
        by_hand = [self._far.candidate(keyframe_id, older_id) for older_id in added]
        new = {one.pair: one for one in reversed((*by_hand, *candidates)) if one.pair not in self._tried}
        near = tuple(attempt for candidate in reversed(new.values()) for attempt in self._attempts(candidate, watch))
        self._take(near)
        is_first_time = below is None and keyframe_id in self._unsearched
        self._unsearched.discard(keyframe_id)
        has_closure = any(isinstance(attempt.outcome, LoopClosure) for attempt in near)
        if has_closure or not is_first_time or not self._config.retrieval.enabled:
            return near
        waiting = {attempt.candidate.pair for attempt in near if _is_unconfirmed(attempt)}
        far = self._far.attempt(keyframe_id, watch, waiting)
        self._take(far)
        return (*near, *far)

    def search_again(self, watch: Stopwatch, *, end_s: float = math.inf) -> Iterator[LoopAttempt]:
        """Try the pairs proposed from the final poses that were not tried before, up to a limit of their number.

        No further keyframe is started after `end_s`, by time.monotonic.
        """
        most = max(LEAST_AGAIN, int(MOST_AGAIN * len(self._tried)))
        for keyframe_id in range(len(self.submaps.T_odom)):
            for attempt in self.attempt(keyframe_id, watch):
                yield attempt
                most -= 1
            if most <= 0 or monotonic() > end_s:
                return

    def take(self, attempts: tuple[LoopAttempt, ...]) -> None:
        """Add the loops of the newest keyframe that were tried in an earlier run; they are not tried again."""
        self._unsearched.discard(len(self.submaps.T_odom) - 1)
        self._take(attempts)

    def _take(self, attempts: tuple[LoopAttempt, ...]) -> None:
        for attempt in attempts:
            self._tried.add(attempt.candidate.pair)
            self._confirmation.note(attempt)
            if isinstance(attempt.outcome, LoopClosure):
                self._graph.add_closure(attempt.outcome)
                self.detector.note_closure(attempt.outcome)

    def _attempts(self, candidate: LoopCandidate, watch: Stopwatch) -> tuple[LoopAttempt, ...]:
        own = Stopwatch()
        source_id, target_id = candidate.pair
        outcome: Alignment | Rejected | None = None
        is_by_hand = candidate.pair in self._edits.added
        if self._is_known:
            with own("prepare"):
                seen = at_once(lambda: self._observed(source_id), lambda: self._observed(target_id))
            outcome = register_near(*seen, candidate.T_target_source_prior, config=self._config, watch=own)
        if not isinstance(outcome, Alignment):
            with own("prepare"):
                source, target = at_once(lambda: self._prepared(source_id), lambda: self._prepared(target_id))
            outcome = register_prepared(
                source,
                target,
                config=self._config,
                gate=anywhere if is_by_hand else prior_gate(candidate, self._config),
                watch=own,
            )
        for stage, seconds in own.seconds.items():
            watch.add(stage, seconds)
        if isinstance(outcome, Rejected):
            return (LoopAttempt(candidate, outcome, own.seconds),)
        closure = LoopClosure.of(candidate.source_id, candidate.target_id, outcome)
        if self._is_known or is_by_hand or self._is_certain(candidate, outcome):
            return (LoopAttempt(candidate, closure, own.seconds),)
        return self._confirmation.attempts(candidate, closure, own.seconds)

    def _is_certain(self, candidate: LoopCandidate, found: Alignment) -> bool:
        """True for a pose that the prior does not contradict, and that is hardly wrong or that of another place.

        By itself, a loop is accepted only with the share of wrong ones that the user accepts. Of the places that the
        scans take for the same, `MISLED` only look so, and fewer where the prior is narrow.
        """
        if found.probability is not None and 1.0 - found.probability > self._config.verify.max_false_share:
            return False
        if far_from_prior(found.T_target_source, candidate, self._config.graph) is not None:
            return False
        near = candidate.near_probability
        return MISLED * (1.0 - near) <= LEAST_PROBABILITY * near


def _is_unconfirmed(attempt: LoopAttempt) -> bool:
    return isinstance(attempt.outcome, Rejected) and attempt.outcome.reason is RejectReason.UNCONFIRMED
