"""How long one scan takes in `Slam.process`, closures and optimisations included."""

from pathlib import Path
from typing import Any

import numpy as np

from segslam import open_dataset
from segslam.core.config import Config
from segslam.slam.slam import Slam


def latency(data: Path, sequence: str, frames: tuple[int, int], *, labels: str) -> dict[str, Any]:
    """Milliseconds of `process`, of odometry in it, of all else, and of the steps that tried a loop."""
    slam = Slam(Config())
    dataset = open_dataset(data, sequence=sequence, frames=f"{frames[0]}:{frames[1]}", labels=labels)
    steps = [slam.process(scan) for scan in dataset]
    odometry = np.array([1e3 * step.stage_seconds["odometry"] for step in steps])
    total = np.array([1e3 * sum(step.stage_seconds.values()) for step in steps])
    tried = np.array([bool(step.attempts) for step in steps])
    return {
        "process_ms": _summary(total),
        "odometry_ms": _summary(odometry),
        "all_else_ms": _summary(total - odometry),
        "with_loops_ms": _summary(total[tried]),
        "share_with_loops": float(tried.mean()),
        "labels": labels,
    }


def _summary(milliseconds: np.ndarray) -> dict[str, float]:
    if not len(milliseconds):
        return {}
    median, p95 = np.percentile(milliseconds, [50, 95])
    return {"median": float(median), "p95": float(p95), "max": float(milliseconds.max())}
