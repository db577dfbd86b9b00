"""Interface of a graph of keyframes, as the pipeline uses it."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from segslam.core.trajectory import Poses
from segslam.core.types import GraphEstimate, Information, LoopClosure, Transform, Vector


@runtime_checkable
class Graph(Protocol):
    """`PoseGraph`, or a graph of the same keyframes in another frame."""

    @property
    def num_keyframes(self) -> int:
        """Number of keyframes added so far."""
        ...

    @property
    def travel_m(self) -> Vector:
        """(n,) travel of each keyframe, by id."""
        ...

    @property
    def T_world_keyframes(self) -> Poses:  # noqa: N802
        """(n, 4, 4) poses by id: the last estimate, continued by odometry for newer keyframes."""
        ...

    @property
    def is_due(self) -> bool:
        """True if enough measurements wait for an optimisation."""
        ...

    def add_keyframe(
        self,
        keyframe_id: int,
        T_odom_keyframe: Transform,
        travel_m: float,
        *,
        information: Information | None = None,
        stamp_ns: int | None = None,
    ) -> None:
        """Add the next keyframe, with an odometry edge from the previous one."""
        ...

    def add_closure(self, closure: LoopClosure) -> None:
        """Add a loop between two keyframes of the graph."""
        ...

    def weigh_odometry_by(self, closure: LoopClosure) -> None:
        """Increase the noise of odometry until the drift measured by a certain closure is a usual one."""
        ...

    def optimize(self) -> GraphEstimate:
        """Optimise with a coarse tolerance, as during the run."""
        ...

    def finish(self) -> GraphEstimate:
        """The final estimate."""
        ...

    def write_g2o(self, path: Path) -> None:
        """Poses and edges as g2o text."""
        ...
