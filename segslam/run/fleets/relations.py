"""Relative poses of drives: inverted, and chained to the poses of a component."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from heapq import heappop, heappush

import numpy as np

from segslam.core import geometry
from segslam.core.types import LoopClosure, Registration, Transform
from segslam.graph.closure_pairs import adjoints
from segslam.run.sessions.recorded import SessionPose
from segslam.run.sessions.session_pose import MOST_FAILED, Relation


def inverted(found: LoopClosure) -> LoopClosure:
    """The same as the pose of the target in the source: `T exp(x)` has the inverse `inverse(T) exp(-Ad(T) x)`."""

    def back(pose: Registration) -> Registration:
        undone = np.linalg.inv(adjoints(pose.T_target_source[None])[0])
        information = undone.T @ pose.information @ undone
        return replace(pose, T_target_source=geometry.inverse(pose.T_target_source), information=information)

    alignment = replace(found.alignment, coarse=back(found.alignment.coarse), fine=back(found.alignment.fine))
    return LoopClosure.of(found.target_id, found.source_id, alignment)


class Components:
    """Which drives are joined, by the relations found so far."""

    def __init__(self, num_drives: int) -> None:
        self._component = list(range(num_drives))
        """Of each drive: the number of the first drive of its component."""
        self._related: list[dict[int, tuple[Transform, tuple[LoopClosure, ...]]]] = [{} for _ in range(num_drives)]
        """Of each drive: its pose in others, and the loops by which it was found there."""
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
        inverse = geometry.inverse(relation.T_earlier_later), tuple(map(inverted, relation.found))
        self._related[later][earlier] = relation.T_earlier_later, relation.found
        self._related[earlier][later] = inverse
        self._component = [one if own == other else own for own in self._component]
        self._num_failed[one] = 0

    def arranged(self) -> Iterator[tuple[list[int], list[SessionPose | None]]]:
        """The drives of each component, each after one in which its pose is known, and these poses.

        Of the drives that may be next the first is, so that one that is added to a fleet is the last if it can be.
        """
        for first in sorted(set(self._component)):
            order, poses = list[int](), list[SessionPose | None]()
            waiting = [(first, -1)]
            while waiting:
                drive, number = heappop(waiting)
                if drive not in order:
                    for other in self._related[drive]:
                        heappush(waiting, (other, len(order)))
                    poses.append(SessionPose(number, *self._related[drive][order[number]]) if order else None)
                    order.append(drive)
            yield order, poses

    def next_pairs(self, similarity: Mapping[tuple[int, int], float]) -> list[tuple[int, int]]:
        """For each component its most similar pair with an earlier drive of another one, of those not tried yet.

        After `MOST_FAILED` pairs of a component that could not be joined, it waits until a drive joins it. The first
        pairs are those of each drive, and a drive that is added to a fleet needs its own pairs only.
        """
        best: dict[int, tuple[float, tuple[int, int]]] = {}
        for pair, value in similarity.items():
            own, other = (self._component[drive] for drive in pair)
            if own != other and pair not in self._tried and self._num_failed[own] < MOST_FAILED:
                best[own] = max(best.get(own, (-math.inf, (0, 0))), (value, (-pair[0], -pair[1])))
        return sorted((-negated[0], -negated[1]) for _, negated in best.values())
