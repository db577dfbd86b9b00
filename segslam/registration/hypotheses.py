"""Coarse poses of a pair of scans: from clusters and features, then from floor plans."""

from collections.abc import Iterator
from functools import lru_cache
from itertools import islice

from segslam import segregator
from segslam.registration.prepared import PreparedScan
from segslam.registration.trial import Trial
from segslam.types import Registration, Rejected

MOST_PLANS = 24
"""Chosen: floor-plan poses looked through for those near the prior, 1 ms each."""

NUM_FLOOR_PLANS = 4
"""Number of floor plans in memory: a scan is compared with several others in turn. A source has 12 MB of spectra."""


def coarse_poses(trial: Trial) -> Iterator[Registration | Rejected]:
    """Hypotheses from clusters and features, then from floor plans.

    Poses that the prior excludes are skipped and not counted: in symmetric places, such as a corridor, most poses
    that fit are turned by 180 degrees or far along it.
    """
    config = trial.config
    with trial.watch("match"):
        ranked = segregator.hypotheses(trial.source.description, trial.target.description, config=config.segregator)
    if isinstance(ranked, Rejected):
        yield ranked
    else:
        possible = [coarse for coarse in ranked if _is_possible(coarse, trial)]
        yield from (possible or ranked[:1])[: config.verify.max_hypotheses]
    yield from plans_near(trial, num_poses=config.verify.max_plan_hypotheses)


def plans_near(trial: Trial, *, num_poses: int) -> list[Registration]:
    """Poses near the prior that align the two floor plans."""
    if num_poses == 0:
        return []
    with trial.watch("match"):
        plans = _floor_plan(trial.source), _floor_plan(trial.target)
        ranked = segregator.plan_hypotheses(*plans, num_poses=max(MOST_PLANS, num_poses))
        return list(islice((coarse for coarse in ranked if _is_possible(coarse, trial)), num_poses))


@lru_cache(NUM_FLOOR_PLANS)
def _floor_plan(scan: PreparedScan) -> segregator.FloorPlan:
    return segregator.FloorPlan(scan.surface.standing, segregator.vertical(scan.description))


def _is_possible(coarse: Registration, trial: Trial) -> bool:
    return trial.gate(coarse.T_target_source, slack_m=trial.config.verify.max_coarse_fine_m) is None
