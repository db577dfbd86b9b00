"""Geometric labels on real scans of KITTI: accuracy per class, and registrations with them."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from segslam.bench.experiments.rows import Row, figures, grouped
from segslam.bench.labelling import confusion, group_scores
from segslam.core.config import Config
from segslam.core.types import Points
from segslam.labels import geometric_labels
from segslam.labels.label_files import computed
from segslam.scans import open_dataset
from tools.benchmarks import real_pairs

Figures = dict[str, Any]


def class_agreement(data: Path) -> dict[str, dict[str, float]]:
    """Intersection over union of each class over the points whose truth is known: of scans 0, 1 and 2, and of all."""
    counts = {
        f"scan {scan.index}": confusion(geometric_labels(scan.points), computed(scan.labels))
        for scan in open_dataset(data / "kitti", sequence="00", frames="0:3")
    }
    counts["all"] = np.sum(list(counts.values()), axis=0)
    return {
        scans: {name: round(score, 3) for name, score in group_scores(of_scans).items()}
        for scans, of_scans in counts.items()
    }


def speed(points: Points, repeats: int = 21) -> dict[str, float]:
    """Milliseconds to label a scan: CPU time of the thread, wall time, and relative to sorting as many numbers."""
    keys = np.random.default_rng(0).random(len(points))
    clocks: dict[str, list[float]] = {"thread": [], "wall": [], "sort": []}
    geometric_labels(points)
    for _ in range(repeats):
        wall, thread = time.perf_counter(), time.thread_time()
        geometric_labels(points)
        clocks["wall"].append(time.perf_counter() - wall)
        clocks["thread"].append(time.thread_time() - thread)
        thread = time.thread_time()
        np.sort(keys)
        clocks["sort"].append(time.thread_time() - thread)
    return {
        "num_points": len(points),
        "thread_ms_median": round(1e3 * float(np.median(clocks["thread"])), 2),
        "thread_ms_p95": round(1e3 * float(np.percentile(clocks["thread"], 95)), 2),
        "wall_ms_median": round(1e3 * float(np.median(clocks["wall"])), 2),
        "thread_in_sorts": round(float(np.median(clocks["thread"]) / np.median(clocks["sort"])), 2),
    }


def pairs_by_labels(data: Path, config: Config, num_yaws: int) -> dict[str, Figures]:
    """The reference pairs at each yaw of a full circle, labels from shape; and, where there are any, a network's."""
    predicted = real_pairs.predicted_pairs(data)
    both = set(map(tuple, predicted.pairs.tolist()))
    shape = real_pairs.register_turned(data, real_pairs.reference_pairs(data), "geometric", config, num_yaws=num_yaws)
    network = real_pairs.register_turned(data, predicted, "predicted_labels", config, num_yaws=num_yaws)
    of_both = [row for row in shape if (row.source, row.target) in both]
    return {
        "shape, all pairs": summary(shape),
        "shape, pairs with predictions": summary(of_both),
        "a network's, the same pairs": summary(network),
    }


def summary(rows: Sequence[Row]) -> Figures:
    """Figures of the refined poses, and of the coarse ones that led to them, over the successes."""
    by_method = grouped(rows, lambda row: row.method)
    found = figures(by_method[real_pairs.REFINED])
    for name, method in (("coarse", real_pairs.COARSE), ("refined", real_pairs.REFINED)):
        good = [row for row in by_method[method] if row.success]
        found[f"{name}_m"] = _mean_and_worst([row.error_m or 0.0 for row in good])
        found[f"{name}_deg"] = _mean_and_worst([row.error_deg or 0.0 for row in good])
    return found


def _mean_and_worst(errors: Sequence[float]) -> tuple[float, float] | None:
    return (round(float(np.mean(errors)), 4), round(max(errors), 4)) if errors else None
