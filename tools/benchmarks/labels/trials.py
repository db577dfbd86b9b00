"""One registration after the other, each judged against the truth, and what they come to."""

import math
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from segslam import geometry
from segslam.config import Config
from segslam.evaluation import SUCCESS_DEG, SUCCESS_M
from segslam.registration import PreparedScan, prepare_scan, register_prepared, shape_labels
from segslam.types import Labels, Points, Rejected, Transform

Trial = dict[str, Any]
"""accepted, success, seconds; reason or, of coarse and refined pose, error_m and error_deg."""
Seconds = Float[np.ndarray, "2"]
"""By the wall's clock, and of all cores together, which other programs on the machine change less."""


def clock() -> Seconds:
    return np.array([time.perf_counter(), time.process_time()])


def prepared(points: Points, labels: Labels | None, config: Config) -> tuple[PreparedScan, Seconds]:
    """A scan made ready, by these labels or by labels from shape, and what that took, labelling included."""
    started = clock()
    classes = shape_labels(points, config=config) if labels is None else labels
    scan = prepare_scan(points, classes, config=config)
    return scan, clock() - started


def attempt(source: PreparedScan, target: PreparedScan, T_true: Transform, config: Config) -> Trial:
    """The whole pipeline on two scans, verification included."""
    started = clock()
    found = register_prepared(source, target, config=config)
    seconds = clock() - started
    if isinstance(found, Rejected):
        return rejected_trial(found, seconds)
    trial = judged_trial(found.fine.T_target_source, T_true, seconds)
    coarse_m, coarse_deg = pose_error(found.coarse.T_target_source, T_true)
    return trial | {"coarse_error_m": coarse_m, "coarse_error_deg": coarse_deg}


def rejected_trial(found: Rejected, seconds: Seconds) -> Trial:
    """Of a method that gave no pose."""
    return {"accepted": False, "success": False, "reason": found.reason.value, "seconds": seconds}


def judged_trial(T_target_source: Transform, T_true: Transform, seconds: Seconds) -> Trial:
    """Of a method that gave a pose."""
    error_m, error_deg = pose_error(T_target_source, T_true)
    success = error_m < SUCCESS_M and error_deg < SUCCESS_DEG
    return {"accepted": True, "success": success, "error_m": error_m, "error_deg": error_deg, "seconds": seconds}


def pose_error(T_target_source: Transform, T_true: Transform) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    T_error = T_target_source @ geometry.inverse(T_true)
    return geometry.distance(T_error), math.degrees(geometry.angle(T_error))


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    """Rates over all trials, errors over the successes."""
    good = [trial for trial in trials if trial["success"]]
    milliseconds = 1e3 * np.stack([trial["seconds"] for trial in trials])
    figures: dict[str, Any] = {
        "num": len(trials),
        "num_success": len(good),
        "success_percent": round(100 * len(good) / len(trials), 1),
        "num_false_accepted": sum(trial["accepted"] and not trial["success"] for trial in trials),
        "rejected": dict(Counter(trial["reason"] for trial in trials if not trial["accepted"])),
        "ms_median": round(float(np.median(milliseconds[:, 0])), 1),
        "ms_p95": round(float(np.percentile(milliseconds[:, 0], 95)), 1),
        "cpu_ms_median": round(float(np.median(milliseconds[:, 1])), 1),
        "cpu_ms_p95": round(float(np.percentile(milliseconds[:, 1], 95)), 1),
    }
    for name in ("coarse_error_m", "coarse_error_deg", "error_m", "error_deg"):
        values = [trial[name] for trial in good if name in trial]
        if values:
            figures |= {f"{name}_mean": round(float(np.mean(values)), 4), f"{name}_max": round(max(values), 4)}
    return figures
