"""Rows to the figures of a table."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from segslam.experiments.rows import Row
from segslam.experiments.workers import LOST_WORKER

STAGES = ("label_ms", "prepare_ms", "match_ms", "refine_ms", "verify_ms")


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """Figures of one method on some pairs; None for unknown figures.

    Errors are means over successes, `accepted_m` and `accepted_deg` over all poses that were given. Times are of a
    registration on its own, both scans prepared for it; `p95_mb` leaves out what a first call loads.
    `mean_edges` is the mean over accepted registrations, the paper's average inlier count (AIC).
    """
    good = [row for row in rows if row.success]
    accepted = [row for row in rows if row.accepted]
    return {
        "num_pairs": len(rows),
        "success_percent": 100.0 * len(good) / len(rows),
        "translation_m": _mean([row.error_m for row in good]),
        "rotation_deg": _mean([row.error_deg for row in good]),
        "accepted_m": _mean([row.error_m for row in accepted]),
        "accepted_deg": _mean([row.error_deg for row in accepted]),
        "num_false_accepted": len(accepted) - len(good),
        "num_rejected": len(rows) - len(accepted),
        "mean_ms": _mean([row.ms for row in rows]),
        "median_ms": _percentile([row.ms for row in rows], 50),
        "p95_ms": _percentile([row.ms for row in rows], 95),
        "median_cpu_ms": _percentile([row.cpu_ms for row in rows], 50),
        "mean_edges": _mean([row.num_edges for row in accepted]),
        "p95_mb": _percentile([row.peak_mb for row in rows], 95),
        "stage_ms": {stage: _percentile([getattr(row, stage) for row in rows], 50) for stage in STAGES},
        "num_lost": sum(row.reason == LOST_WORKER for row in rows),
    }


def results(rows: Sequence[Row], *, by: str) -> dict[str, dict[str, Any]]:
    """The figures of each method over all rows, and in `by` for each value of what was varied, one of `VARIED`."""
    return {
        method: figures(own) | {"by": [{by: value} | figures(some) for value, some in grouped(own, VARIED[by]).items()]}
        for method, own in grouped(rows, lambda row: row.method).items()
    }


VARIED: dict[str, Callable[[Row], Any]] = {
    "list": lambda row: row.pairs,
    "yaw_deg": lambda row: row.source_yaw_deg,
    "lost_percent": lambda row: round(100 * row.source_lost, 6),
}
"""What an experiment varies, read from a row."""


def grouped(rows: Sequence[Row], key: Callable[[Row], Hashable]) -> dict[Any, list[Row]]:
    """The rows by a key, in the order in which its values first come."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def worst_failures(rows: Sequence[Row], count: int) -> list[Row]:
    """Accepted poses that are wrong, the farthest first; then what was rejected."""
    failures = [row for row in rows if not row.success]
    return sorted(failures, key=lambda row: -(row.error_m or 0.0))[:count]


def _known(values: Sequence[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _mean(values: Sequence[float | None]) -> float | None:
    known = _known(values)
    return float(np.mean(known)) if known else None


def _percentile(values: Sequence[float | None], percent: float) -> float | None:
    known = _known(values)
    return float(np.percentile(known, percent)) if known else None
