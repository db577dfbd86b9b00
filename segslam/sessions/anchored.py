"""The graph of a drive in the frame of an old map that does not move.

The map is one vertex more, which comes before all keyframes and is held where it is. Nothing is known of the motion
from it to the first keyframe, as after a break of the odometry, and each keyframe that was placed in the map closes a
loop with it. The robust optimisation of loops and breaks holds for placements as they are.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from segslam.config import GraphConfig
from segslam.pose_graph import PoseGraph
from segslam.proximity import BREAK_TRAVEL_M
from segslam.trajectory import Poses
from segslam.types import (
    GraphEstimate,
    Information,
    LoopClosure,
    Placement,
    SegslamError,
    Transform,
    Vector,
)

OPTIMIZE_EVERY = 25
"""Chosen: placements between two optimisations while running; the pose of a keyframe is its placement until then."""


class AnchoredGraph:
    """Keyframes of ids 0, 1, 2, ... in the world of an old map, as `PoseGraph` has them in their own."""

    def __init__(self, config: GraphConfig) -> None:
        self._graph = PoseGraph(config)
        self._graph.add_keyframe(0, np.eye(4), 0.0)
        self._placements: list[int] = []
        self._num_waiting = 0
        self.weights: dict[int, float] = {}
        """Keyframe -> 0 (rejected) to 1 (full weight), of those placed when the graph was last optimised."""

    @property
    def num_keyframes(self) -> int:
        """Those added so far."""
        return self._graph.num_keyframes - 1

    @property
    def travel_m(self) -> Vector:
        """(n,) travel of each keyframe, by id."""
        return self._graph.travel_m[1:] - BREAK_TRAVEL_M

    @property
    def T_world_keyframes(self) -> Poses:  # noqa: N802
        """(n, 4, 4) by id, in the map's world: the last estimate, and odometry from there for newer keyframes."""
        return self._graph.T_world_keyframes[1:]

    @property
    def is_due(self) -> bool:
        """Whether placements enough wait for an optimisation: the first, or `OPTIMIZE_EVERY`."""
        return self._num_waiting >= OPTIMIZE_EVERY or 0 < self._num_waiting == len(self._placements)

    def add_keyframe(
        self,
        keyframe_id: int,
        T_odom_keyframe: Transform,
        travel_m: float,
        *,
        information: Information | None = None,
    ) -> None:
        """As `PoseGraph.add_keyframe`."""
        if keyframe_id == 0:
            information = np.zeros((6, 6))
        self._graph.add_keyframe(keyframe_id + 1, T_odom_keyframe, travel_m + BREAK_TRAVEL_M, information=information)

    def add_closure(self, closure: LoopClosure) -> None:
        """Raises SegslamError: a localised drive has no loops of its own."""
        raise SegslamError(f"keyframe {closure.source_id}: a drive that is placed in an old map takes no loops")

    def weigh_odometry_by(self, closure: LoopClosure) -> None:
        """Raises SegslamError, as `add_closure` does."""
        self.add_closure(closure)

    def place(self, placement: Placement) -> None:
        """Place a keyframe of the graph in the map; it takes effect with the next optimisation."""
        source_id = placement.keyframe_id + 1
        self._graph.add_closure(
            LoopClosure(source_id, 0, placement.T_world_keyframe, placement.information, placement.alignment)
        )
        self._placements.append(placement.keyframe_id)
        self._num_waiting += 1

    def optimize(self) -> GraphEstimate:
        """As `PoseGraph.optimize`."""
        return self._taken(self._graph.optimize())

    def finish(self) -> GraphEstimate:
        """As `PoseGraph.finish`; `weights` then contains the rejected placements."""
        return self._taken(self._graph.finish())

    def write_g2o(self, path: Path) -> None:
        """As `PoseGraph.write_g2o`; vertex 0 is the map's origin, keyframe k is vertex k + 1."""
        self._graph.write_g2o(path)

    def _taken(self, estimate: GraphEstimate) -> GraphEstimate:
        self._num_waiting = 0
        self.weights = {source_id - 1: weight for (source_id, _), weight in estimate.closure_weights.items()}
        return replace(
            estimate,
            T_world_keyframe=dict(enumerate(self.T_world_keyframes)),
            closure_weights={},
            motion_weights=_renumbered(estimate.motion_weights.items()),
        )


def _renumbered(weights: Iterable[tuple[tuple[int, int], float]]) -> dict[tuple[int, int], float]:
    return {(before - 1, after - 1): weight for (before, after), weight in weights if before > 0}
