"""The pose graph of a drive in the frame of an existing map, which is fixed.

The map is an additional, fixed vertex before all keyframes. The motion from it to the first keyframe is unknown, like
that across a break of the odometry. Each keyframe that was placed in the map has a loop closure with it. The robust
optimisation of loops and breaks therefore applies to placements without change.
"""

from dataclasses import replace

import numpy as np

from segslam.core.config import GraphConfig
from segslam.core.types import GraphEstimate, LoopClosure, Placement
from segslam.graph.graph import PoseGraph

OPTIMIZE_EVERY = 25
"""Chosen: placements between two optimisations during the run; until then the pose of a keyframe is its placement."""
MAP_ID = -1
"""Id that stands for the map beside those of keyframes."""


class AnchoredGraph(PoseGraph):
    """Keyframes 0, 1, 2, ... in the world frame of an existing map.

    Before the first keyframe is a break. In a g2o file, vertex 0 is the map's origin, keyframe k is vertex k + 1.
    """

    _first = 1

    def __init__(self, config: GraphConfig) -> None:
        super().__init__(config)
        self.add_keyframe(MAP_ID, np.eye(4), 0.0)
        self._num_placements = self._num_waiting = 0
        self.weights: dict[int, float] = {}
        """Weight of each keyframe placed before the last optimisation: 0 (rejected) to 1 (full weight)."""

    @property
    def is_due(self) -> bool:
        """True if enough placements wait for an optimisation: the first, or `OPTIMIZE_EVERY`."""
        return self._num_waiting >= OPTIMIZE_EVERY or 0 < self._num_waiting == self._num_placements

    def place(self, placement: Placement) -> None:
        """Place a keyframe in the map; takes effect in the next optimisation."""
        pose = placement.T_world_keyframe, placement.information
        self.add_closure(LoopClosure(placement.keyframe_id, MAP_ID, *pose, placement.alignment))
        self._num_placements += 1
        self._num_waiting += 1

    def _estimate(self, error: float) -> GraphEstimate:
        """As in the base class, without the map; `weights` contains those of the placements."""
        estimate = super()._estimate(error)
        self._num_waiting = 0
        self.weights = {keyframe_id: weight for (keyframe_id, _), weight in estimate.closure_weights.items()}
        motions = {pair: weight for pair, weight in estimate.motion_weights.items() if MAP_ID not in pair}
        return replace(estimate, closure_weights={}, motion_weights=motions)
