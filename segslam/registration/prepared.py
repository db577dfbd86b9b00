"""A scan prepared for registration: described, downsampled with normals, and its free space."""

from collections.abc import Callable
from dataclasses import dataclass

from segslam.core.config import Config
from segslam.core.types import Description, Label, Labels, Points
from segslam.registration import refinement, segregator
from segslam.registration.free_space import FreeSpace

Labeller = Callable[[Points], Labels]


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """What a scan saw: sufficient to refine and verify a pose that is nearly known."""

    surface: refinement.Surface
    free_space: FreeSpace


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScan(Observed):
    """A scan prepared for registration; computed once per scan."""

    description: Description


def prepare_scan(
    points: Points, labels: Labels, *, config: Config, seen_from_here: Points | None = None
) -> PreparedScan:
    """Description, surface and free space of a scan; `points` in the scan's own frame.

    If `points` are gathered from several scans, `seen_from_here` are the points measured from this pose: free space is
    computed from these only. Points of moving classes are used for neither surface nor free space.
    """
    seen = prepare_observed(points, labels, config=config, seen_from_here=seen_from_here)
    return PreparedScan(seen.surface, seen.free_space, segregator.describe(points, labels, config=config.segregator))


def prepare_observed(
    points: Points, labels: Labels, *, config: Config, seen_from_here: Points | None = None
) -> Observed:
    """Surface and free space as in `prepare_scan`."""
    still = points.compress(labels < Label.MOVING_CAR, axis=0)
    surface = refinement.Surface(refinement.downsample(still, config=config.refine), config.refine)
    return Observed(surface, FreeSpace(still if seen_from_here is None else seen_from_here))
