"""Rows to the figures of a table."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from segslam.experiments.rows import Row
from segslam.experiments.workers import LOST_WORKER

STAGES = ("label_ms", "prepare_ms", "match_ms", "refine_ms", "verify_ms")


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """What one method did on some pairs; None where nothing tells.

    Errors are means over successes. Times are of a registration on its own, both scans prepared for it.
    `mean_edges` is the mean over accepted registrations, the paper's average inlier count (AIC).
    """
    good = [row for row in rows if row.success]
    accepted = [row for row in rows if row.accepted]
    return {
        "num_pairs": len(rows),
        "success_percent": 100.0 * len(good) / len(rows),
        "translation_m": _mean([row.error_m for row in good]),
        "rotation_deg": _mean([row.error_deg for row in good]),
        "num_false_accepted": len(accepted) - len(good),
        "num_rejected": len(rows) - len(accepted),
        "median_ms": _percentile([row.ms for row in rows], 50),
        "p95_ms": _percentile([row.ms for row in rows], 95),
        "median_cpu_ms": _percentile([row.cpu_ms for row in rows], 50),
        "mean_edges": _mean([row.num_edges for row in accepted]),
        "peak_mb": max(_known([row.peak_mb for row in rows]), default=None),
        "stage_ms": {stage: _percentile([getattr(row, stage) for row in rows], 50) for stage in STAGES},
        "num_lost": sum(row.reason == LOST_WORKER for row in rows),
    }


def by_method(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each method, in the order in which the methods first come."""
    methods: dict[str, list[Row]] = {}
    for row in rows:
        methods.setdefault(row.method, []).append(row)
    return methods


def success_percent(rows: Sequence[Row]) -> float:
    """Of these rows, at least one."""
    return 100.0 * sum(row.success for row in rows) / len(rows)


def _known(values: Sequence[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _mean(values: Sequence[float | None]) -> float | None:
    known = _known(values)
    return float(np.mean(known)) if known else None


def _percentile(values: Sequence[float | None], percent: float) -> float | None:
    known = _known(values)
    return float(np.percentile(known, percent)) if known else None
