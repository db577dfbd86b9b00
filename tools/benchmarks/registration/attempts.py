"""Registrations compared with ground truth, and tables of simulated pairs at real poses.

These are success by distance, false acceptances and rejections, calibration.
"""

import math
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from segslam.bench.experiments.pairs import Trial
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import Alignment, Registration, Rejected, Transform
from segslam.registration import refinement, segregator
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.verification import register_prepared
from tools.benchmarks.common import RIGHT, PoseError, Row, draw_pairs
from tools.benchmarks.registration.scans import BANDS_M, Labelled, SimulatedPlace, by_shape

NEGATIVE_M = 100.0
"""Scans farther apart do not overlap within the registered range."""
CHI2_95 = 12.592
"""0.95 quantile of chi-square with 6 degrees of freedom."""
LOST = PoseError(math.inf, math.inf)
"""Error of a rejected registration."""


def error(found: Registration | Rejected, T_true: Transform) -> PoseError:
    """The paper's: of dT = T_estimate inverse(T_true)."""
    return LOST if isinstance(found, Rejected) else PoseError.of(found.T_target_source @ geometry.inverse(T_true))


def preparer(scan: Callable[[int], Labelled], config: Config) -> Callable[[int], PreparedScan]:
    """Each scan prepared once."""
    return cache(lambda index: prepare_scan(*scan(index), config=config))


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


def scan_of(place: SimulatedPlace, labels: str) -> Callable[[int], Labelled]:
    """The place's scans with the labels `given`, or labelled by `shape`."""
    return place.scan if labels == "given" else by_shape(lambda index: place.scan(index)[0])


def simulated(
    places: list[SimulatedPlace], config: Config, *, sample: int, num_negatives: int, rng: np.random.Generator
) -> dict[str, list[Row]]:
    """Tables with a row for each place and source of labels, the first also for each band of distances."""
    successes, gates, informations = list[Row](), list[Row](), list[Row]()
    for place in places:
        for labels in ("given", "shape"):
            name = {"place": place.name, "labels": labels}
            prepared = preparer(scan_of(place, labels), config)
            seen: set[int] = set()
            trials: dict[tuple[int, int], list[Attempt]] = {}
            for band_m in BANDS_M:
                pairs = place.pairs(band_m, sample)
                trials[band_m] = [attempt(pair, prepared, config=config) for pair in pairs]
                seen |= {scan.index for pair in pairs for scan in (pair.source, pair.target)}
            whole = [trial for some in trials.values() for trial in some]
            negatives = _negatives(place, sorted(seen), num_negatives, prepared, config, rng)
            successes += [name | _success(band_m, some) for band_m, some in trials.items()]
            gates.append(name | _gates(whole, negatives))
            informations.append(name | _information(whole))
            print(gates[-1], informations[-1], file=sys.stderr, flush=True)
    return {
        "Simulated pairs at real poses": successes,
        "Gates: simulated scans over 100 m apart, and true pairs rejected": gates,
        "Squared errors by the information claimed": informations,
    }


def _negatives(
    place: SimulatedPlace,
    indices: list[int],
    count: int,
    prepared: Callable[[int], PreparedScan],
    config: Config,
    rng: np.random.Generator,
) -> Counter[str]:
    """Outcomes of random pairs without overlap: reasons, and number of acceptances."""
    at = place.T_world_lidar[indices, :2, 3]
    far = np.linalg.norm(at[:, None] - at, axis=-1) > NEGATIVE_M
    outcomes: Counter[str] = Counter()
    for source, target in draw_pairs(far, count, rng):
        outcome = register_prepared(prepared(indices[source]), prepared(indices[target]), config=config)
        outcomes["accepted" if isinstance(outcome, Alignment) else outcome.reason.value] += 1
    return outcomes


def _success(band_m: tuple[int, int], trials: list[Attempt]) -> dict[str, object]:
    good = [trial for trial in trials if trial.fine.success]
    return {
        "apart_m": f"{band_m[0]}-{band_m[1]}",
        "pairs": len(trials),
        "coarse_percent": percent([trial.coarse.success for trial in trials]),
        "accepted_percent": percent([trial.fine.success for trial in trials]),
        "accepted_wrong": sum(trial.wrong for trial in trials),
        "fine_mean_m": round(float(np.mean([trial.fine.translation_m for trial in good])), 3) if good else None,
        "fine_mean_deg": round(float(np.mean([trial.fine.rotation_deg for trial in good])), 3) if good else None,
    }


def _gates(trials: list[Attempt], negatives: Counter[str]) -> dict[str, object]:
    return {
        "negatives": negatives.total(),
        "accepted": negatives["accepted"],
        "reasons": ", ".join(f"{reason} {count}" for reason, count in negatives.most_common()),
        "true_pairs": sum(trial.refined.within(*RIGHT) for trial in trials),
        "lost": sum(trial.lost for trial in trials),
        "accepted_wrong": sum(trial.wrong for trial in trials),
    }


def _information(trials: list[Attempt]) -> dict[str, object]:
    """Whitened squared errors of correct poses: mean 6 and 95 % below the bound if the information is correct."""
    coarse = np.array([trial.coarse_squared for trial in trials if trial.coarse.success])
    fine = np.array([trial.fine_squared for trial in trials if trial.fine.within(*RIGHT)])
    return {
        "coarse_poses": len(coarse),
        "coarse_mean": round(float(coarse.mean()), 2),
        "coarse_within_95": percent(list(coarse < CHI2_95)),
        "fine_poses": len(fine),
        "fine_mean": round(float(fine.mean()), 2),
        "fine_within_95": percent(list(fine < CHI2_95)),
    }
