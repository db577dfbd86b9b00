"""Relative poses of drives: inverted, and chained to the poses of a component."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from heapq import heappop, heappush

import numpy as np

from segslam.core import geometry
from segslam.core.types import LoopClosure, Registration
from segslam.graph.closure_pairs import adjoints
from segslam.run.sessions.recorded import SessionPose
from segslam.run.sessions.session_pose import MOST_FAILED, Relation


def inverted(found: LoopClosure) -> LoopClosure:
    """The same as the pose of the target in the source."""
    alignment = found.alignment
    back = replace(alignment, coarse=_inverted(alignment.coarse), fine=_inverted(alignment.fine))
    return LoopClosure.of(found.target_id, found.source_id, back)


def _inverted(pose: Registration) -> Registration:
    """`T exp(x)` has the inverse `inverse(T) exp(-Ad(T) x)`."""
    undone = np.linalg.inv(adjoints(pose.T_target_source[None])[0])
    information = undone.T @ pose.information @ undone
    return replace(pose, T_target_source=geometry.inverse(pose.T_target_source), information=information)


class Components:
    """Which drives are joined, by the relations found so far."""

    def __init__(self, num_drives: int) -> None:
        self._component = list(range(num_drives))
        """Of each drive: the number of the first drive of its component."""
        self._relations: dict[tuple[int, int], Relation] = {}
        self._tried = set[tuple[int, int]]()
        self._num_failed = [0] * num_drives
        """By component: pairs that could not be joined since its last drive was."""

    def add(self, later: int, earlier: int, relation: Relation) -> None:
        """Join two drives, unless they are joined already, or their relation is unknown."""
        self._tried.add((later, earlier))
        one, other = sorted((self._component[later], self._component[earlier]))
        if relation.T_earlier_later is None:
            self._num_failed[self._component[later]] += 1
        if relation.T_earlier_later is None or one == other:
            return
        self._relations[later, earlier] = relation
        self._component = [one if own == other else own for own in self._component]
        self._num_failed[one] = 0

    def arranged(self) -> Iterator[tuple[list[int], list[SessionPose | None]]]:
        """The drives of each component, each after one in which its pose is known, and these poses.

        Of the drives that may be next the first is, so that one that is added to a fleet is the last if it can be.
        """
        related = defaultdict[int, list[int]](list)
        for later, earlier in self._relations:
            related[later].append(earlier)
            related[earlier].append(later)
        for first in sorted(set(self._component)):
            order, poses = list[int](), list[SessionPose | None]()
            waiting = [(first, -1)]
            while waiting:
                drive, number = heappop(waiting)
                if drive not in order:
                    for other in related[drive]:
                        heappush(waiting, (other, len(order)))
                    poses.append(self._pose(drive, order[number], number) if order else None)
                    order.append(drive)
            yield order, poses

    def _pose(self, drive: int, before: int, number: int) -> SessionPose:
        """The pose of a drive in one that it is related to, which has this number in the order."""
        relation = self._relations.get((drive, before)) or self._relations[before, drive]
        assert relation.T_earlier_later is not None
        if (drive, before) in self._relations:
            return SessionPose(number, relation.T_earlier_later, relation.found)
        found = tuple(inverted(one) for one in relation.found)
        return SessionPose(number, geometry.inverse(relation.T_earlier_later), found)

    def next_pairs(self, similarity: Mapping[tuple[int, int], float]) -> list[tuple[int, int]]:
        """For each component its most similar pair with an earlier drive of another one, of those not tried yet.

        After `MOST_FAILED` pairs of a component that could not be joined, it waits until a drive joins it. The first
        pairs are those of each drive, and a drive that is added to a fleet needs its own pairs only.
        """
        best: dict[int, tuple[float, tuple[int, int]]] = {}
        for pair, value in similarity.items():
            own, other = (self._component[drive] for drive in pair)
            if own != other and pair not in self._tried and self._num_failed[own] < MOST_FAILED:
                best[own] = max(best.get(own, (0.0, (0, 0))), (value, (-pair[0], -pair[1])))
        return sorted((-negated[0], -negated[1]) for _, negated in best.values())
