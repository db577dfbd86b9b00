"""Common result of all registration methods."""

from dataclasses import dataclass

from segslam.core.types import Transform


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The pose of the source in the target, and figures of the method; None for figures that it does not have."""

    T_target_source: Transform
    num_correspondences: int | None = None
    num_inliers: int | None = None
    num_edges: int | None = None
    """Number of edges of the consistency graph."""
    probability: float | None = None
    """That the pose is right."""
    evidence: dict[str, float] | None = None
    """As that of `segslam.types.Alignment`."""
