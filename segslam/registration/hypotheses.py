"""Coarse poses of a pair of scans: from clusters and features, then from floor plans."""

from collections.abc import Iterator
from copy import copy
from functools import lru_cache
from itertools import islice, tee
from typing import NamedTuple, Protocol, runtime_checkable

from segslam.core.config import Config
from segslam.core.threads import Stopwatch
from segslam.core.types import Registration, Rejected, Transform
from segslam.registration import segregator
from segslam.registration.prepared import PreparedScan

MAX_HYPOTHESES = 3
"""Chosen: number of coarse poses tried, the best first."""
MAX_PLAN_HYPOTHESES = 6
"""Chosen: number of poses tried after these, from aligning the two floor plans."""
MAX_COARSE_FINE_M = 2.0
"""Chosen: largest correction of a coarse pose by refinement (m)."""

MOST_PLANS = 24
"""Chosen: floor-plan poses looked through for those near the prior, 1 ms each."""

NUM_FLOOR_PLANS = 4
"""Number of floor plans in memory: a scan is compared with several others in turn. A source has 12 MB of spectra."""


@runtime_checkable
class Gate(Protocol):
    """Prior knowledge about the pose: a rejection for an impossible pose, None for all others."""

    def __call__(self, T_target_source: Transform, *, slack_m: float) -> Rejected | None:
        """`slack_m`: distance by which refinement may still move the pose."""
        ...


def anywhere(T_target_source: Transform, *, slack_m: float) -> Rejected | None:
    """The gate of scans without prior knowledge."""
    return None


class Pair(NamedTuple):
    """Two scans, and what is known about the pose of the source in the target before they are compared."""

    source: PreparedScan
    target: PreparedScan
    config: Config
    gate: Gate
    watch: Stopwatch


def coarse_poses(pair: Pair) -> Iterator[Registration | Rejected]:
    """Hypotheses from clusters and features, then from floor plans.

    Poses that the prior excludes are skipped and not counted: in symmetric places, such as a corridor, most poses
    that fit are turned by 180 degrees or far along it.
    """
    config = pair.config
    with pair.watch("match"):
        ranked = segregator.hypotheses(pair.source.description, pair.target.description, config=config.segregator)
    if isinstance(ranked, Rejected):
        yield ranked
    else:
        possible = [coarse for coarse in ranked if _is_possible(coarse, pair)]
        yield from (possible or ranked[:1])[:MAX_HYPOTHESES]
    yield from plans_near(pair, num_poses=MAX_PLAN_HYPOTHESES)


def plans_near(pair: Pair, *, num_poses: int) -> list[Registration]:
    """Poses near the prior that align the two floor plans."""
    if num_poses == 0:
        return []
    with pair.watch("match"):
        ranked = copy(_ranked_plans(pair.source, pair.target))
        return list(islice((coarse for coarse in ranked if _is_possible(coarse, pair)), num_poses))


@lru_cache(1)
def _ranked_plans(source: PreparedScan, target: PreparedScan) -> Iterator[Registration]:
    """Poses by the floor plans, the best first; copies start again, so that rivals need no other search."""
    (plans,) = tee(segregator.plan_hypotheses(_floor_plan(source), _floor_plan(target), num_poses=MOST_PLANS), 1)
    return plans


@lru_cache(NUM_FLOOR_PLANS)
def _floor_plan(scan: PreparedScan) -> segregator.FloorPlan:
    return segregator.FloorPlan(scan.surface.standing()[0], segregator.vertical(scan.description))


def _is_possible(coarse: Registration, pair: Pair) -> bool:
    return pair.gate(coarse.T_target_source, slack_m=MAX_COARSE_FINE_M) is None
