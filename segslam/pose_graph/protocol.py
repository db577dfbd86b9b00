"""What the pipeline needs of a graph of keyframes."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from segslam.trajectory import Poses
from segslam.types import GraphEstimate, Information, LoopClosure, Transform, Vector


@runtime_checkable
class Graph(Protocol):
    """`PoseGraph`, or one that has the same keyframes in another frame."""

    @property
    def num_keyframes(self) -> int:
        """Those added so far."""
        ...

    @property
    def travel_m(self) -> Vector:
        """(n,) travel of each keyframe, by id."""
        ...

    @property
    def T_world_keyframes(self) -> Poses:  # noqa: N802
        """(n, 4, 4) by id: the last estimate, and odometry from there for keyframes that are newer."""
        ...

    @property
    def is_due(self) -> bool:
        """Whether measurements enough wait for an optimisation."""
        ...

    def add_keyframe(
        self,
        keyframe_id: int,
        T_odom_keyframe: Transform,
        travel_m: float,
        *,
        information: Information | None = None,
    ) -> None:
        """Add the next keyframe, tied by odometry to the one before."""
        ...

    def add_closure(self, closure: LoopClosure) -> None:
        """A loop between two keyframes that the graph holds."""
        ...

    def weigh_odometry_by(self, closure: LoopClosure) -> None:
        """Raise the noise of odometry until the drift that a certain closure measures is a usual one."""
        ...

    def optimize(self) -> GraphEstimate:
        """An estimate good enough to go on with."""
        ...

    def finish(self) -> GraphEstimate:
        """The final estimate."""
        ...

    def write_g2o(self, path: Path) -> None:
        """Poses and edges as g2o text."""
        ...
