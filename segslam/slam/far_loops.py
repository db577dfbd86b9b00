"""Loop closing by place recognition, independent of drift: keyframes similar to an older place, wherever it is.

A loop is closed only if several keyframes confirm it (`Confirmation`).
"""

import math
from collections.abc import Callable, Collection, Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np

from segslam.candidates import PlaceCandidate, Places, PlaceSignature
from segslam.candidates.places import OTHER_PLACE_M, SAME_PLACE_M
from segslam.candidates.proximity import LEAST_PROBABILITY, Nearness, nearness
from segslam.core.config import Config
from segslam.core.threads import Stopwatch
from segslam.core.types import LoopAttempt, LoopCandidate, LoopClosure, Rejected, RejectReason, Transform
from segslam.graph import PoseGraph
from segslam.graph.confirmation import Confirmation
from segslam.registration.prepared import PreparedScan
from segslam.slam.recognition import MAX_PLACES, recognise

MIN_SCORE = 0.6
"""Chosen on the real places of KITTI 05: 97 % of the revisits are more similar, 99 % of other best places less."""
MOST_DRIFT = 0.25
"""Chosen: largest error of the odometry, as a share of the travel."""


class FarLoops:
    """Registers keyframes with similar places, and closes the loops that several keyframes confirm."""

    def __init__(
        self,
        config: Config,
        graph: PoseGraph,
        prepared: Callable[[int], PreparedScan],
        confirmation: Confirmation,
        forbidden: frozenset[tuple[int, int]],
    ) -> None:
        """`forbidden`: pairs (newer, older) of keyframes that are never tried."""
        self._config, self._graph = config, graph
        self._prepared = prepared
        self._confirmation = confirmation
        self._forbidden = forbidden
        self._places = Places()
        self._signatures: dict[int, PlaceSignature] = {}
        self._rejected_m = -math.inf
        """Travel at the last rejection."""

    def add(self, keyframe_id: int, signature: PlaceSignature) -> None:
        """Add the newest keyframe."""
        self._places.add(keyframe_id, signature)
        self._signatures[keyframe_id] = signature

    def attempt(
        self, keyframe_id: int, watch: Stopwatch, waiting: Collection[tuple[int, int]]
    ) -> tuple[LoopAttempt, ...]:
        """Try the place most similar to that of a keyframe, once; closures follow once enough others confirm it.

        `waiting`: pairs that the search by distance has registered, and which wait for confirmation already.
        """
        with watch("propose"):
            loop = self._loop(keyframe_id, self._signatures[keyframe_id])
        if loop is None or loop.candidate.pair in waiting:
            return ()
        candidate = loop.candidate
        own = Stopwatch()
        found = recognise(
            self._prepared(keyframe_id),
            [PlaceCandidate(candidate.target_id, 1.0, 0.0)],
            self._prepared,
            lambda number: self._graph.T_world_keyframes[number],
            config=self._config,
            gate=lambda place_id: loop,
            watch=own,
        )
        for stage, seconds in own.seconds.items():
            watch.add(stage, seconds)
        if isinstance(found, Rejected):
            self._rejected_m = float(self._graph.travel_m[keyframe_id])
            return (LoopAttempt(candidate, found, own.seconds),)
        closure = LoopClosure.of(keyframe_id, candidate.target_id, found.alignment)
        return self._confirmation.attempts(candidate, closure, own.seconds)

    def _loop(self, keyframe_id: int, signature: PlaceSignature) -> "_FarLoop | None":
        """With the most similar older place within the largest drift; None if only the search by distance may try."""
        travel_m = self._graph.travel_m
        if (
            not self._confirmation.is_waiting(keyframe_id)
            and abs(travel_m[keyframe_id] - self._rejected_m) < SAME_PLACE_M
        ):
            return None
        num_old = int(
            np.searchsorted(travel_m, travel_m[keyframe_id] - self._config.proximity.min_travel_m, side="right")
        )
        listed = self._places.shortlist(signature, most=MAX_PLACES, below_id=min(num_old, keyframe_id))
        ids = [
            one.place_id
            for one in listed
            if one.score >= MIN_SCORE and (keyframe_id, one.place_id) not in self._forbidden
        ]
        near = self._nearness(keyframe_id, ids)
        drift_m = (MOST_DRIFT * (travel_m[keyframe_id] - travel_m[near.ids])).tolist()
        loops = map(_FarLoop, map(near.candidate, range(len(ids))), drift_m, near.reach_m.tolist())
        is_here = (near.same_height >= LEAST_PROBABILITY).tolist()  # storeys look the same
        return next((loop for loop in compress(loops, is_here) if loop.is_left), None)

    def candidate(self, keyframe_id: int, target_id: int) -> LoopCandidate:
        """A loop between these two."""
        return self._nearness(keyframe_id, [target_id]).candidate(0)

    def _nearness(self, keyframe_id: int, ids: Sequence[int]) -> Nearness:
        radius_m = self._config.proximity.base_radius_m
        others, T_world = np.array(ids, dtype=np.int64), self._graph.T_world_keyframes
        return nearness(keyframe_id, others, T_world, self._graph.covariances, radius_m=radius_m)


class _FarLoop(NamedTuple):
    """A loop with a similar place, and the gate of its pose."""

    candidate: LoopCandidate
    most_drift_m: float
    near_m: float
    """Largest distance at which the two may seem to be and yet be near each other."""

    @property
    def is_left(self) -> bool:
        """True for a place that the search by distance does not try: elsewhere, or near after unknown motions."""
        distance_m = self.candidate.distance_m
        if distance_m >= OTHER_PLACE_M:
            return distance_m <= self.most_drift_m + OTHER_PLACE_M
        return self.candidate.near_probability < LEAST_PROBABILITY and distance_m <= self.near_m

    def __call__(self, T_target_source: Transform, *, slack_m: float) -> Rejected | None:
        """Rejects poses beyond the largest drift, and poses as predicted of places that are surely not near."""
        predicted_m = self.candidate.distance_m
        off_m = float(np.linalg.norm(T_target_source[:3, 3] - self.candidate.T_target_source_prior[:3, 3]))
        if off_m > self.most_drift_m + slack_m:
            return Rejected(RejectReason.FAR_FROM_PRIOR, f"distance {off_m:.1f} m > {self.most_drift_m:.1f} m")
        if off_m + slack_m < self.near_m < predicted_m:
            return Rejected(RejectReason.FAR_FROM_PRIOR, f"near the predicted position, {predicted_m:.1f} m away")
        return None
