"""One registration, judged by the truth; and what many of them come to."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from segslam import geometry, refinement, segregator
from segslam.config import Config
from segslam.evaluation import SUCCESS_DEG, SUCCESS_M
from segslam.registration import PreparedScan, Stopwatch, prepare_scan, register_prepared
from segslam.types import Alignment, Registration, Rejected, Transform
from tools.benchmarks.registration.scans import Labelled

RIGHT_M, RIGHT_DEG = 0.5, 2.0
"""Chosen: a refined pose that is farther off has found another minimum; right ones are off by centimetres."""

Row = dict[str, object]
"""A line of a table."""


@dataclass(frozen=True, slots=True)
class Error:
    metres: float
    degrees: float

    def within(self, metres: float, degrees: float) -> bool:
        return self.metres < metres and self.degrees < degrees


LOST = Error(math.inf, math.inf)
"""Of a registration that was rejected."""


def error(T_estimate: Transform, T_true: Transform) -> Error:
    """The paper's: of dT = T_estimate inverse(T_true)."""
    T_error = T_estimate @ geometry.inverse(T_true)
    return Error(geometry.distance(T_error), math.degrees(geometry.angle(T_error)))


def error_of(outcome: Registration | Rejected, T_true: Transform) -> Error:
    return LOST if isinstance(outcome, Rejected) else error(outcome.T_target_source, T_true)


def preparer(scan: Callable[[int], Labelled], config: Config) -> Callable[[int], PreparedScan]:
    """Each scan prepared once."""

    @cache
    def prepared(index: int) -> PreparedScan:
        return prepare_scan(*scan(index), config=config)

    return prepared


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A pair whose pose is known, put through everything."""

    coarse: Error
    """Of the best hypothesis, before anything is checked."""
    refined: Error
    """Of the same, refined."""
    outcome: Alignment | Rejected
    fine: Error
    """Of the pose accepted."""
    coarse_squared: float
    """Squared error of the best hypothesis by the information that it claims; NaN where there is none."""
    fine_squared: float
    """The same of the pose accepted."""
    seconds: dict[str, float]

    @property
    def accepted(self) -> bool:
        return isinstance(self.outcome, Alignment)

    @property
    def wrong(self) -> bool:
        """Accepted, and not what the paper calls a success."""
        return self.accepted and not self.fine.within(SUCCESS_M, SUCCESS_DEG)

    @property
    def lost(self) -> bool:
        """Turned down although the best hypothesis led to the right pose."""
        return not self.accepted and self.refined.within(RIGHT_M, RIGHT_DEG)


def attempt(source: PreparedScan, target: PreparedScan, T_true: Transform, *, config: Config) -> Trial:
    coarse = segregator.match(source.description, target.description, config=config.segregator)
    refined: Registration | Rejected = coarse
    if isinstance(coarse, Registration):
        refined = refinement.refine(source.surface, target.surface, coarse.T_target_source, config=config.refine)
    watch = Stopwatch()
    outcome = register_prepared(source, target, config=config, watch=watch)
    fine = outcome.fine if isinstance(outcome, Alignment) else outcome
    return Trial(
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


def spread(seconds: list[float]) -> Row:
    """Median and 95th percentile in ms."""
    return {
        "median_ms": round(1e3 * float(np.median(seconds)), 1),
        "p95_ms": round(1e3 * float(np.percentile(seconds, 95)), 1),
    }
