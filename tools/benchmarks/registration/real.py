"""The real pairs whose pose is known to centimetres, the source turned by each yaw of a full circle."""

import math
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np

from segslam import geometry
from segslam.config import Config
from segslam.registration import PreparedScan, prepare_scan
from segslam.semantics import geometric_labels
from tools.benchmarks.registration.scans import Pair, are_predicted, real_labels, real_points, reference_pairs
from tools.benchmarks.registration.trials import Row, Trial, attempt, percent

FAR_M = 20.0
NEAR_BOUND, FAR_BOUND = (0.3, 1.0), (0.5, 2.0)
"""m, degrees that a coarse pose may be off, up to FAR_M and beyond."""
REFINED_BOUND = (0.05, 0.2)

Prepared = Callable[[int, float, bool], PreparedScan]


def real_pairs(data: Path, config: Config, *, num_yaws: int) -> list[Row]:
    """A row a pair. Labels are a network's where both scans have them, by shape elsewhere (of the turned points)."""
    points_of = cache(partial(real_points, data))
    labels_of = cache(partial(real_labels, data))

    @cache
    def prepared(index: int, turn_rad: float, predicted: bool) -> PreparedScan:
        turn = geometry.transform(geometry.yaw(turn_rad), 0.0)
        points = geometry.apply(turn, points_of(index).astype(np.float64)).astype(np.float32)
        labels = labels_of(index) if predicted else geometric_labels(points, config=config.geometric)
        return prepare_scan(points, labels, config=config)

    turns = [2 * math.pi * k / num_yaws for k in range(num_yaws)]
    pairs = sorted(reference_pairs(data), key=lambda pair: pair.source)
    return [_row(pair, [_turned(pair, turn, prepared, config) for turn in turns]) for pair in pairs]


def _turned(pair: Pair, turn_rad: float, prepared: Prepared, config: Config) -> Trial:
    T_source_turned = geometry.transform(geometry.yaw(-turn_rad), 0.0)
    predicted = are_predicted(pair)
    source, target = prepared(pair.source, turn_rad, predicted), prepared(pair.target, 0.0, predicted)
    return attempt(source, target, pair.T_target_source @ T_source_turned, config=config)


def _row(pair: Pair, trials: list[Trial]) -> Row:
    apart_m = geometry.distance(pair.T_target_source)
    bound = NEAR_BOUND if apart_m <= FAR_M else FAR_BOUND
    return {
        "pair": f"{pair.source} -> {pair.target}",
        "apart_m": round(apart_m, 1),
        "labels": "network" if are_predicted(pair) else "shape",
        "yaws": len(trials),
        "coarse_percent": percent([trial.coarse.within(*bound) for trial in trials]),
        "coarse_worst_m": round(max(trial.coarse.metres for trial in trials), 3),
        "coarse_worst_deg": round(max(trial.coarse.degrees for trial in trials), 2),
        "refined_percent": percent([trial.fine.within(*REFINED_BOUND) for trial in trials]),
        "refined_worst_m": round(max(trial.fine.metres for trial in trials), 3),
        "refined_worst_deg": round(max(trial.fine.degrees for trial in trials), 2),
        "least_overlap": round(min(getattr(trial.outcome, "overlap", 0.0) for trial in trials), 2),
    }
