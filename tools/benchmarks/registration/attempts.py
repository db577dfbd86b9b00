"""One registration compared with ground truth, and statistics of many."""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from segslam.bench.experiments.pairs import Trial
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.evaluation import PoseError
from segslam.core.types import Alignment, Registration, Rejected, Transform
from segslam.registration import refinement, segregator
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.verification import register_prepared
from tools.benchmarks.common import RIGHT
from tools.benchmarks.registration.scans import Labelled

LOST = PoseError(math.inf, math.inf)
"""Error of a rejected registration."""


def error(found: Registration | Rejected, T_true: Transform) -> PoseError:
    """The paper's: of dT = T_estimate inverse(T_true)."""
    return LOST if isinstance(found, Rejected) else PoseError.of(found.T_target_source @ geometry.inverse(T_true))


def preparer(scan: Callable[[int], Labelled], config: Config) -> Callable[[int], PreparedScan]:
    """Each scan prepared once."""

    @cache
    def prepared(index: int) -> PreparedScan:
        return prepare_scan(*scan(index), config=config)

    return prepared


class Attempt(NamedTuple):
    """A pair with known pose, processed by all stages."""

    coarse: PoseError
    """Error of the best hypothesis before verification."""
    refined: PoseError
    """Error of the best hypothesis after refinement."""
    fine: PoseError
    """Error of the accepted pose."""
    coarse_squared: float
    """Squared error of the best hypothesis, whitened by its information; NaN without one."""
    fine_squared: float
    """The same for the accepted pose."""

    @property
    def wrong(self) -> bool:
        """Accepted, but not a success by the criterion of the paper."""
        return self.fine != LOST and not self.fine.success

    @property
    def lost(self) -> bool:
        """Rejected although refinement of the best hypothesis is correct."""
        return self.fine == LOST and self.refined.within(*RIGHT)


def attempt(trial: Trial, prepared: Callable[[int], PreparedScan], *, config: Config) -> Attempt:
    source, target, T_true = prepared(trial.source.index), prepared(trial.target.index), trial.T_target_source
    coarse = segregator.match(source.description, target.description, config=config.segregator)
    refined: Registration | Rejected = coarse
    if isinstance(coarse, Registration):
        refined = refinement.refine(source.surface, target.surface, coarse.T_target_source, config=config.refine)
    found = register_prepared(source, target, config=config)
    fine = found.fine if isinstance(found, Alignment) else found
    errors = error(coarse, T_true), error(refined, T_true), error(fine, T_true)
    return Attempt(*errors, _squared(coarse, T_true), _squared(fine, T_true))


def _squared(found: Registration | Rejected, T_true: Transform) -> float:
    if isinstance(found, Rejected):
        return math.nan
    xi = geometry.log(geometry.inverse(T_true) @ found.T_target_source)
    return float(xi @ found.information @ xi)


def percent(flags: list[bool]) -> float:
    return round(100.0 * float(np.mean(flags)), 1) if flags else math.nan
