"""Registration of pairs of submaps."""

from collections.abc import Iterator
from dataclasses import dataclass

from segslam import geometry
from segslam.adjustment.alignment import Alignment, align
from segslam.adjustment.submaps import Submaps
from segslam.config import Config
from segslam.pose_graph import Edge
from segslam.refinement import limited_information
from segslam.trajectory import Poses
from segslam.types import IndexPairs, Information

MOST_ANGLES = 300
"""Chosen: number of pairs that measure the vertical angle, evenly among all; each takes half as long again."""


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredPair:
    """The alignment of a submap (source) with another one (target)."""

    target_id: int
    source_id: int
    alignment: Alignment
    information: Information
    """That of the alignment, with the errors that its points have in common."""

    def edge(self, *, angle_rad: float, share: float) -> Edge:
        """The edge with a share of the information, once all beams are raised by an angle."""
        T_target_source = geometry.nearest_transform(self.alignment.at_angle(angle_rad))
        return Edge(self.target_id, self.source_id, T_target_source, share * self.information)


def register_pairs(
    pairs: IndexPairs, submaps: Submaps, T_world: Poses, *, config: Config
) -> Iterator[RegisteredPair | None]:
    """Register each pair (target, source) from its current pose; None without convergence or enough overlap."""
    angle_every = max(1, len(pairs) // MOST_ANGLES)
    for row, (target_id, source_id) in enumerate(pairs.tolist()):
        T_prior = geometry.inverse(T_world[target_id]) @ T_world[source_id]
        found = align(submaps.submap(source_id), submaps.submap(target_id), T_prior, with_angle=row % angle_every == 0)
        if found is None or found.overlap < config.adjustment.min_overlap:
            yield None
            continue
        information = limited_information(config.refine.information_scale * found.information, config=config.refine)
        yield RegisteredPair(target_id, source_id, found, information)
