"""Statistics of rows for the tables."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from segslam.bench.experiments.job import LOST_WORKER
from segslam.bench.experiments.rows import Row

STAGES = ("label_ms", "prepare_ms", "match_ms", "refine_ms", "verify_ms")


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """Statistics of one method over some pairs; None for unknown values.

    Errors are means over successes; `accepted_m` and `accepted_deg` are means over all returned poses. Times are those
    of a single registration including the preparation of both scans; `p95_mb` excludes memory for imports on the first
    call. `mean_edges` is the mean over accepted registrations, the paper's average inlier count (AIC).
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
    """Statistics of each method over all rows and, under the key `by`, for each value of a quantity in `VARIED`."""
    return {
        method: figures(own) | {"by": [{by: value} | figures(some) for value, some in grouped(own, VARIED[by]).items()]}
        for method, own in grouped(rows, lambda row: row.method).items()
    }


VARIED: dict[str, Callable[[Row], Any]] = {
    "list": lambda row: row.pairs,
    "yaw_deg": lambda row: row.source_yaw_deg,
    "lost_percent": lambda row: round(100 * row.source_lost, 6),
}
"""Quantities that an experiment varies, as functions of a row."""


def grouped(rows: Sequence[Row], key: Callable[[Row], Hashable]) -> dict[Any, list[Row]]:
    """The rows grouped by a key, in the order in which its values first occur."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def worst_failures(rows: Sequence[Row], count: int) -> list[Row]:
    """Wrong accepted poses, largest error first; then rejected registrations."""
    failures = [row for row in rows if not row.success]
    return sorted(failures, key=lambda row: -(row.error_m or 0.0))[:count]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _percentile(values: Sequence[float | None], percent: float) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.percentile(known, percent)) if known else None
