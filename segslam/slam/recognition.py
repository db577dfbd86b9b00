"""Recognition of the place of a scan, without initial guess: the most similar places are aligned and verified in turn.

A place is accepted only if no other place fits almost as well, because streets repeat.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np

from segslam.candidates import PlaceCandidate
from segslam.candidates.places import OTHER_PLACE_M, SAME_PLACE_M
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.threads import Stopwatch, at_once
from segslam.core.types import Alignment, Record, Rejected, RejectReason, Transform
from segslam.registration.prepared import PreparedScan
from segslam.verification.pair import tried_poses
from segslam.verification.trial import Found, Gate, Trial, anywhere, judged

MAX_PLACES = 6
"""Chosen: number of places tried until one is found; each takes about 100 ms."""
MAX_RIVALS = 2
"""Chosen: number of other places tried after one is found."""
NO_PATCHES = np.empty(0, np.int8)
"""The patches of another place are not those of the place found."""


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

    def tried(place_id: int, T_world_found: Transform | None = None) -> list[Found] | Rejected:
        """The poses at a place; after one was found, those that are elsewhere."""
        with watch("prepare"):
            place = places(place_id)
        gate_here, T_world_here = gate(place_id), T_world_place(place_id)

        def allowed(T_target_source: Transform, *, slack_m: float) -> Rejected | None:
            rejected = gate_here(T_target_source, slack_m=slack_m)
            if rejected is not None or T_world_found is None:
                return rejected
            is_same = _apart_m(T_world_here @ T_target_source, T_world_found) < OTHER_PLACE_M
            return Rejected(RejectReason.FAR_FROM_PRIOR, "the same place") if is_same else None

        return tried_poses(Trial(scan, place, config, allowed, watch))

    def found_elsewhere(T_world_found: Transform, place_ids: Sequence[int]) -> list[Found]:
        """The best poses at other places, by what the patches of the scan show there."""
        outcomes = [tried(place_id, T_world_found) for place_id in place_ids]
        best = [found[0] for found in outcomes if not isinstance(found, Rejected)]
        return [one._replace(agreement=one.agreement._replace(of_target=NO_PATCHES)) for one in best]

    rejections = []
    place_ids = [candidate.place_id for candidate in candidates]
    for place_id in islice(spread(place_ids, T_world_place, SAME_PLACE_M), max_places):
        found = tried(place_id)
        if isinstance(found, Rejected):
            rejections.append(found)
            continue
        outcome = judged(found[0], found[1:], config=config)
        if isinstance(outcome, Rejected):
            rejections.append(outcome)
            continue
        T_world_lidar = T_world_place(place_id) @ found[0].T_target_source
        others = list(islice(spread(place_ids, T_world_place, OTHER_PLACE_M, [T_world_lidar]), MAX_RIVALS))
        halves = at_once(*(partial(found_elsewhere, T_world_lidar, half) for half in (others[0::2], others[1::2])))
        outcome = judged(found[0], [*found[1:], *halves[0], *halves[1]], config=config)
        return outcome if isinstance(outcome, Rejected) else Recognised(place_id, T_world_lidar, outcome)
    return rejections[0] if rejections else Rejected(RejectReason.TOO_FEW_CORRESPONDENCES, "no place to compare with")


def spread(
    place_ids: Sequence[int], T_world_place: Callable[[int], Transform], apart_m: float, taken: Sequence[Transform] = ()
) -> Iterator[int]:
    """The places that are at least so far from all before, and from those that are taken already."""
    taken = list(taken)
    for place_id in place_ids:
        T_world = T_world_place(place_id)
        if all(_apart_m(T_world, other) >= apart_m for other in taken):
            taken.append(T_world)
            yield place_id


def _apart_m(T_world_a: Transform, T_world_b: Transform) -> float:
    return geometry.distance(geometry.inverse(T_world_a) @ T_world_b)
