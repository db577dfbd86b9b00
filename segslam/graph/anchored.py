"""The pose graph of a drive in the frame of an existing map, which is fixed.

The map is an additional, fixed vertex before all keyframes. The motion from it to the first keyframe is unknown, like
that across a break of the odometry. Each keyframe that was placed in the map has a loop closure with it. The robust
optimisation of loops and breaks therefore applies to placements without change.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np

from segslam.core.config import GraphConfig
from segslam.core.trajectory import Poses
from segslam.core.types import (
    GraphEstimate,
    Indices,
    Information,
    LoopClosure,
    Placement,
    SegslamError,
    Transform,
    Vector,
)
from segslam.graph.closure_pairs import Matrices
from segslam.graph.graph import PoseGraph

OPTIMIZE_EVERY = 25
"""Chosen: placements between two optimisations during the run; until then the pose of a keyframe is its placement."""


class AnchoredGraph:
    """Keyframes 0, 1, 2, ... in the world frame of an existing map, with the interface of `PoseGraph`."""

    def __init__(self, config: GraphConfig) -> None:
        self._graph = PoseGraph(config)
        self._graph.add_keyframe(0, np.eye(4), 0.0)
        self._num_placements = self._num_waiting = 0
        self.weights: dict[int, float] = {}
        """Weight of each keyframe placed before the last optimisation: 0 (rejected) to 1 (full weight)."""

    @property
    def num_keyframes(self) -> int:
        """Number of keyframes added so far."""
        return self._graph.num_keyframes - 1

    @property
    def travel_m(self) -> Vector:
        """As that of `PoseGraph`; before the first keyframe is a break."""
        return self._graph.travel_m[1:]

    @property
    def num_breaks(self) -> Indices:
        """As that of `PoseGraph`, 1 or more."""
        return self._graph.num_breaks[1:]

    @property
    def motion_variance(self) -> Vector:
        """As that of `PoseGraph`."""
        return self._graph.motion_variance[1:]

    @property
    def T_world_keyframes(self) -> Poses:  # noqa: N802
        """(n, 4, 4) poses by id in the map's world: the last estimate, continued by odometry for newer keyframes."""
        return self._graph.T_world_keyframes[1:]

    @property
    def is_due(self) -> bool:
        """True if enough placements wait for an optimisation: the first, or `OPTIMIZE_EVERY`."""
        return self._num_waiting >= OPTIMIZE_EVERY or 0 < self._num_waiting == self._num_placements

    def add_keyframe(
        self,
        keyframe_id: int,
        T_odom_keyframe: Transform,
        travel_m: float,
        *,
        information: Information | None = None,
        stamp_ns: int | None = None,
    ) -> None:
        """As `PoseGraph.add_keyframe`."""
        if keyframe_id == 0:
            information = np.zeros((6, 6))
        self._graph.add_keyframe(keyframe_id + 1, T_odom_keyframe, travel_m, information=information, stamp_ns=stamp_ns)

    def add_closure(self, closure: LoopClosure) -> NoReturn:
        """Raises SegslamError: a localised drive has no loops of its own."""
        raise SegslamError(f"keyframe {closure.source_id}: a drive localised in a map cannot have loops of its own")

    weigh_odometry_by = add_closure

    def consistent_pairs(self, closures: Sequence[LoopClosure]) -> NoReturn:
        """As `add_closure`."""
        self.add_closure(closures[0])

    def covariances(self, keyframe_id: int, others: Indices) -> Matrices:
        """As `PoseGraph.covariances`."""
        return self._graph.covariances(keyframe_id + 1, others + 1)

    def place(self, placement: Placement) -> None:
        """Place a keyframe in the map; takes effect in the next optimisation."""
        source_id = placement.keyframe_id + 1
        self._graph.add_closure(
            LoopClosure(source_id, 0, placement.T_world_keyframe, placement.information, placement.alignment)
        )
        self._num_placements += 1
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
            motion_weights={(a - 1, b - 1): weight for (a, b), weight in estimate.motion_weights.items() if a > 0},
        )
