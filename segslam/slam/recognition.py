"""Recognition of the place of a scan, without initial guess: the most similar places are aligned and verified in turn.

A place is accepted only if no other place fits almost as well, because streets repeat.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from segslam.candidates import PlaceCandidate
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.threads import Stopwatch, at_once
from segslam.core.types import Alignment, Record, Rejected, RejectReason, Transform
from segslam.registration.hypotheses import Gate, anywhere
from segslam.registration.prepared import PreparedScan
from segslam.verification import score
from segslam.verification.pair import tried_poses
from segslam.verification.trial import Found, Trial

MAX_PLACES = 6
"""Chosen: number of places tried until one is found; each takes about 100 ms."""
MAX_RIVALS = 2
"""Chosen: number of other places tried after one is found."""
SPREAD_M = 4.0
"""Chosen: candidates nearer than this to a tried one are the same place."""
NO_PATCHES = np.empty(0, np.int8)
"""The patches of another place are not those of the place found."""
ELSEWHERE_M = 10.0
"""Chosen: a candidate farther than this from the found place is another place."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Recognised(Record):
    """The pose of a scan at a place."""

    place_id: int
    T_world_lidar: Transform
    alignment: Alignment
    """Alignment of the scan in the frame of the place."""


def recognise(
    scan: PreparedScan,
    candidates: Sequence[PlaceCandidate],
    places: Callable[[int], PreparedScan],
    T_world_place: Callable[[int], Transform],
    *,
    config: Config,
    gate: Callable[[int], Gate] = lambda place_id: anywhere,
    max_places: int = MAX_PLACES,
    watch: Stopwatch | None = None,
) -> Recognised | Rejected:
    """The place at which a scan was taken, among candidates sorted by similarity.

    Rejects with AMBIGUOUS if another place fits almost as well; with the reason of the first candidate if none fits;
    with TOO_FEW_CORRESPONDENCES if there are no candidates. `gate` adds prior knowledge about the pose at a place.
    """
    watch = watch or Stopwatch()

    def tried(place_id: int, also: Gate) -> tuple[Trial, list[Found] | Rejected]:
        with watch("prepare"):
            place = places(place_id)
        trial = Trial(scan, place, config, _Both(gate(place_id), also), watch, score.shipped())
        return trial, tried_poses(trial)

    rejection: Rejected | None = None
    for place_id in _spread(candidates, T_world_place, max_places):
        trial, found = tried(place_id, anywhere)
        if isinstance(found, Rejected):
            outcome: Alignment | Rejected = found
        else:
            outcome = trial.judge(found[0], found[1:])
        if isinstance(outcome, Alignment):
            assert not isinstance(found, Rejected)
            T_world_lidar = T_world_place(place_id) @ found[0].T_target_source
            others = _others(T_world_lidar, candidates, T_world_place)
            elsewhere = [(other, _Elsewhere(T_world_lidar, T_world_place(other))) for other in others]
            halves = at_once(partial(_found, tried, elsewhere[0::2]), partial(_found, tried, elsewhere[1::2]))
            outcome = trial.judge(found[0], [*found[1:], *halves[0], *halves[1]])
            return outcome if isinstance(outcome, Rejected) else Recognised(place_id, T_world_lidar, outcome)
        if rejection is None:
            rejection = outcome
    if rejection is None:
        return Rejected(RejectReason.TOO_FEW_CORRESPONDENCES, "no place to compare with")
    return rejection


def _found(
    tried: Callable[[int, Gate], tuple[Trial, list[Found] | Rejected]], places: Sequence[tuple[int, Gate]]
) -> list[Found]:
    """The best poses at other places, by what the patches of the scan show there."""
    outcomes = [tried(*place)[1] for place in places]
    best = [found[0] for found in outcomes if not isinstance(found, Rejected)]
    return [one._replace(agreement=one.agreement._replace(of_target=NO_PATCHES)) for one in best]


class _Both(NamedTuple):
    """Combination of two gates."""

    first: Gate
    second: Gate

    def __call__(self, T_target_source: Transform, *, slack_m: float) -> Rejected | None:
        rejected = self.first(T_target_source, slack_m=slack_m)
        return rejected if rejected is not None else self.second(T_target_source, slack_m=slack_m)


class _Elsewhere(NamedTuple):
    """Rejects poses near a place that was found already."""

    T_world_found: Transform
    T_world_target: Transform

    def __call__(self, T_target_source: Transform, *, slack_m: float) -> Rejected | None:
        if _apart_m(self.T_world_target @ T_target_source, self.T_world_found) < ELSEWHERE_M:
            return Rejected(RejectReason.FAR_FROM_PRIOR, "the same place")
        return None


def _spread(
    candidates: Sequence[PlaceCandidate], T_world_place: Callable[[int], Transform], most: int
) -> Iterator[int]:
    """At most `most` candidates, each `SPREAD_M` from all previous ones."""
    taken: list[Transform] = []
    for candidate in candidates:
        T_world = T_world_place(candidate.place_id)
        if all(_apart_m(T_world, other) >= SPREAD_M for other in taken):
            taken.append(T_world)
            yield candidate.place_id
        if len(taken) == most:
            return


def _others(
    T_world_found: Transform, candidates: Sequence[PlaceCandidate], T_world_place: Callable[[int], Transform]
) -> list[int]:
    """At most `MAX_RIVALS` most similar places, `ELSEWHERE_M` from the found one and from each other."""
    taken: list[int] = []
    for candidate in candidates:
        T_world = T_world_place(candidate.place_id)
        if _apart_m(T_world, T_world_found) < ELSEWHERE_M:
            continue
        if all(_apart_m(T_world, T_world_place(other)) >= ELSEWHERE_M for other in taken):
            taken.append(candidate.place_id)
        if len(taken) == MAX_RIVALS:
            break
    return taken


def _apart_m(T_world_a: Transform, T_world_b: Transform) -> float:
    return geometry.distance(geometry.inverse(T_world_a) @ T_world_b)
