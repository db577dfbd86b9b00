"""Simulated pairs at real poses: success by distance, false acceptances and rejections, calibration."""

import sys
from collections import Counter
from collections.abc import Callable

import numpy as np

from segslam.core.config import Config
from segslam.core.types import Alignment
from segslam.registration.prepared import PreparedScan
from segslam.verification import register_prepared
from tools.benchmarks.common import RIGHT, Row, draw_pairs
from tools.benchmarks.registration.attempts import Attempt, attempt, percent, preparer
from tools.benchmarks.registration.scans import BANDS_M, Labelled, SimulatedPlace, by_shape

NEGATIVE_M = 100.0
"""Scans farther apart do not overlap within the registered range."""
CHI2_95 = 12.592
"""0.95 quantile of chi-square with 6 degrees of freedom."""


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
