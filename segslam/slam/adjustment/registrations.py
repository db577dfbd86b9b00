"""Registration of pairs of submaps."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.trajectory import Poses
from segslam.core.types import IndexPairs, Information, Transform
from segslam.graph import Edge
from segslam.registration.refinement import INFORMATION_SCALE, limited_information
from segslam.slam.adjustment.alignment import Alignment

Aligned = Callable[[int, int, Transform], Alignment | None]
"""The alignment of a target and a source, by their ids, near an initial guess."""
MIN_OVERLAP = 0.1
"""Chosen on KITTI 00: smallest share of a submap's points that lie on the other."""


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredPair:
    """The alignment of a submap (source) with another one (target)."""

    target_id: int
    source_id: int
    alignment: Alignment
    information: Information
    """That of the alignment, with the errors that its points have in common."""

    def edge(self, *, share: float) -> Edge:
        """The edge with a share of the information."""
        T_target_source = geometry.nearest_transform(self.alignment.T_target_source)
        return Edge(self.target_id, self.source_id, T_target_source, share * self.information)


def register_pairs(
    pairs: IndexPairs, aligned: Aligned, T_world: Poses, *, config: RefineConfig
) -> Iterator[RegisteredPair | None]:
    """Register each pair (target, source) from its current pose; None without convergence or enough overlap."""
    for target_id, source_id in pairs.tolist():
        T_prior = geometry.inverse(T_world[target_id]) @ T_world[source_id]
        found = aligned(target_id, source_id, T_prior)
        if found is None or found.overlap < MIN_OVERLAP:
            yield None
            continue
        information = limited_information(INFORMATION_SCALE * found.information, config=config)
        yield RegisteredPair(target_id, source_id, found, information)
