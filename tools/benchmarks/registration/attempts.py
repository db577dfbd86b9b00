"""One registration compared with ground truth, and statistics of many."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from segslam.bench.experiments.pairs import Trial
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.evaluation import PoseError
from segslam.core.threads import Stopwatch
from segslam.core.types import Alignment, Registration, Rejected, Transform
from segslam.registration import refinement, segregator
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.verification import register_prepared
from tools.benchmarks.common import RIGHT
from tools.benchmarks.registration.scans import Labelled

LOST = PoseError(math.inf, math.inf)
"""Error of a rejected registration."""


def error(T_estimate: Transform, T_true: Transform) -> PoseError:
    """The paper's: of dT = T_estimate inverse(T_true)."""
    return PoseError.of(T_estimate @ geometry.inverse(T_true))


def error_of(outcome: Registration | Rejected, T_true: Transform) -> PoseError:
    return LOST if isinstance(outcome, Rejected) else error(outcome.T_target_source, T_true)


def preparer(scan: Callable[[int], Labelled], config: Config) -> Callable[[int], PreparedScan]:
    """Each scan prepared once."""

    @cache
    def prepared(index: int) -> PreparedScan:
        return prepare_scan(*scan(index), config=config)

    return prepared


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """A pair with known pose, processed by all stages."""

    coarse: PoseError
    """Error of the best hypothesis before verification."""
    refined: PoseError
    """Error of the best hypothesis after refinement."""
    outcome: Alignment | Rejected
    fine: PoseError
    """Error of the accepted pose."""
    coarse_squared: float
    """Squared error of the best hypothesis, whitened by its information; NaN without one."""
    fine_squared: float
    """The same for the accepted pose."""
    seconds: dict[str, float]

    @property
    def accepted(self) -> bool:
        return isinstance(self.outcome, Alignment)

    @property
    def wrong(self) -> bool:
        """Accepted, but not a success by the criterion of the paper."""
        return self.accepted and not self.fine.success

    @property
    def lost(self) -> bool:
        """Rejected although refinement of the best hypothesis is correct."""
        return not self.accepted and self.refined.within(*RIGHT)


def attempt(trial: Trial, prepared: Callable[[int], PreparedScan], *, config: Config) -> Attempt:
    source, target, T_true = prepared(trial.source.index), prepared(trial.target.index), trial.T_target_source
    coarse = segregator.match(source.description, target.description, config=config.segregator)
    refined: Registration | Rejected = coarse
    if isinstance(coarse, Registration):
        refined = refinement.refine(source.surface, target.surface, coarse.T_target_source, config=config.refine)
    watch = Stopwatch()
    outcome = register_prepared(source, target, config=config, watch=watch)
    fine = outcome.fine if isinstance(outcome, Alignment) else outcome
    return Attempt(
        coarse=error_of(coarse, T_true),
        refined=error_of(refined, T_true),
        outcome=outcome,
        fine=error_of(fine, T_true),
        coarse_squared=_squared(coarse, T_true),
        fine_squared=_squared(fine, T_true),
        seconds=watch.seconds,
    )


def _squared(found: Registration | Rejected, T_true: Transform) -> float:
    if isinstance(found, Rejected):
        return math.nan
    xi = geometry.log(geometry.inverse(T_true) @ found.T_target_source)
    return float(xi @ found.information @ xi)


def percent(flags: list[bool]) -> float:
    return round(100.0 * float(np.mean(flags)), 1) if flags else math.nan
