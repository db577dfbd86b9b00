"""Labels from shape on real scans of KITTI: against the truth of each class, and by the registrations they allow."""

import json
import math
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from segslam import geometry
from segslam.config import Config
from segslam.datasets import open_dataset
from segslam.registration import PreparedScan
from segslam.semantics import geometric_labels
from segslam.types import GROUND_LABELS, Label, Points, Scan
from tools.benchmarks.labels.trials import Trial, attempt, prepared, summary

CLASSES = {
    "ground": GROUND_LABELS,
    "car": (Label.CAR, Label.MOVING_CAR),
    "building": (Label.BUILDING,),
    "vegetation": (Label.VEGETATION,),
    "trunk_or_pole": (Label.TRUNK, Label.POLE),
}
PREDICTED = (0, 20, 30, 4413)
"""Scans that a network's labels are there for."""


def class_agreement(data: Path, config: Config) -> dict[str, dict[str, float]]:
    """Intersection over union of each class over the points whose truth is known: of scans 0, 1 and 2, and of all."""
    counts: dict[str, dict[str, np.ndarray]] = {"all": {name: np.zeros(2) for name in CLASSES}}
    for scan in open_dataset(data / "kitti", sequence="00", frames="0:3"):
        known = scan.labels != Label.UNLABELLED
        labels, truth = geometric_labels(scan.points, config=config.geometric)[known], scan.labels[known]
        counts[f"scan {scan.index}"] = {}
        for name, members in CLASSES.items():
            ours, theirs = np.isin(labels, members), np.isin(truth, members)
            both_either = np.array([(ours & theirs).sum(), (ours | theirs).sum()])
            counts[f"scan {scan.index}"][name] = both_either
            counts["all"][name] += both_either
    return {
        scans: {name: round(float(both / either), 3) for name, (both, either) in of_class.items()}
        for scans, of_class in counts.items()
    }


def speed(points: Points, config: Config, repeats: int = 21) -> dict[str, float]:
    """Milliseconds to label a scan, by the thread's own clock and by the wall's, and in sorts of as many numbers."""
    keys = np.random.default_rng(0).random(len(points))
    clocks: dict[str, list[float]] = {"thread": [], "wall": [], "sort": []}
    geometric_labels(points, config=config.geometric)
    for _ in range(repeats):
        wall, thread = time.perf_counter(), time.thread_time()
        geometric_labels(points, config=config.geometric)
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


def pairs_by_labels(data: Path, config: Config, num_yaws: int) -> dict[str, Any]:
    """The reference pairs at each yaw of a full circle, labels from shape; and, where there are any, a network's."""
    rows = json.loads((data / "kitti" / "reference_pairs.json").read_text())
    shape = _turned_pairs(rows, _scans(data, "none"), num_yaws, config, by_shape=True)
    predicted_rows = [row for row in rows if row["source"] in PREDICTED and row["target"] in PREDICTED]
    predicted = _turned_pairs(predicted_rows, _scans(data, "predicted_labels"), num_yaws, config, by_shape=False)
    same = [trial for row in predicted_rows for trial in shape[row["source"], row["target"]]]
    return {
        "num_yaws": num_yaws,
        "pairs": {f"{source}->{target}": summary(trials) for (source, target), trials in shape.items()},
        "shape, all pairs": summary([trial for trials in shape.values() for trial in trials]),
        "shape, pairs with predictions": summary(same),
        "a network's, the same pairs": summary([trial for trials in predicted.values() for trial in trials]),
    }


def _scans(data: Path, labels: str) -> dict[int, Scan]:
    return {scan.index: scan for scan in open_dataset(data / "kitti", sequence="00", labels=labels)}


def _turned_pairs(
    rows: list[dict[str, Any]], scans: dict[int, Scan], num_yaws: int, config: Config, *, by_shape: bool
) -> dict[tuple[int, int], list[Trial]]:
    """The trials of each pair, the source turned by each yaw."""
    ready = _preparer(scans, config, by_shape=by_shape)
    trials: dict[tuple[int, int], list[Trial]] = {(row["source"], row["target"]): [] for row in rows}
    for yaw in range(num_yaws):
        T_turned_source = geometry.transform(geometry.yaw(2 * math.pi * yaw / num_yaws), np.zeros(3))
        turned = cache(lambda index, T=T_turned_source: ready(index, T))
        for row in rows:
            T_true = np.array(row["T_target_source"]) @ geometry.inverse(T_turned_source)
            source, target = turned(row["source"]), ready(row["target"], None)
            trials[row["source"], row["target"]].append(attempt(source, target, T_true, config))
    return trials


def _preparer(
    scans: dict[int, Scan], config: Config, *, by_shape: bool
) -> Callable[[int, np.ndarray | None], PreparedScan]:
    """Makes a scan ready, turned about its sensor or, once for all, as it is."""

    def made(index: int, T_turned_source: np.ndarray) -> PreparedScan:
        scan = scans[index]
        points = geometry.apply(T_turned_source, scan.points.astype(np.float64)).astype(np.float32)
        return prepared(points, None if by_shape else scan.labels, config)[0]

    unturned = cache(lambda index: made(index, np.eye(4)))
    return lambda index, T: unturned(index) if T is None else made(index, T)
