"""The real pairs whose pose is known to centimetres, the source turned by each yaw of a full circle."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from segslam.bench.experiments import rows
from segslam.bench.experiments.summary import grouped
from segslam.core.config import Config
from segslam.core.evaluation import PoseError
from tools.benchmarks import real_pairs
from tools.benchmarks.common import Row

FAR_M = 20.0
NEAR_BOUND, FAR_BOUND = (0.3, 1.0), (0.5, 2.0)
"""m, degrees that a coarse pose may be off, up to FAR_M and beyond."""
REFINED_BOUND = (0.05, 0.2)


def real(data: Path, config: Config, *, num_yaws: int) -> list[Row]:
    """A row a pair and source of labels: shape for all pairs, a network where both scans have its labels."""
    table: list[Row] = []
    for labels, pairs in (
        ("geometric", real_pairs.reference_pairs(data)),
        ("predicted_labels", real_pairs.predicted_pairs(data)),
    ):
        done = real_pairs.register_turned(data, pairs, labels, config, num_yaws=num_yaws)
        for (source, target), some in grouped(done, lambda row: (row.source, row.target)).items():
            apart_m = float(np.linalg.norm((pairs.truth or {})[source, target][:3, 3]))
            table.append({"pair": f"{source} -> {target}", "labels": labels} | _figures(some, apart_m))
    return table


def _figures(some: Sequence[rows.Row], apart_m: float) -> Row:
    by_method = grouped(some, lambda row: row.method)
    coarse = [_error(row) for row in by_method[real_pairs.COARSE]]
    fine = [_error(row) for row in by_method[real_pairs.REFINED]]
    bound = NEAR_BOUND if apart_m <= FAR_M else FAR_BOUND
    return {
        "apart_m": round(apart_m, 1),
        "yaws": len(fine),
        "coarse_percent": round(100.0 * float(np.mean([error.within(*bound) for error in coarse])), 1),
        "coarse_worst_m": round(max(error.translation_m for error in coarse), 3),
        "coarse_worst_deg": round(max(error.rotation_deg for error in coarse), 2),
        "refined_percent": round(100.0 * float(np.mean([error.within(*REFINED_BOUND) for error in fine])), 1),
        "refined_worst_m": round(max(error.translation_m for error in fine), 3),
        "refined_worst_deg": round(max(error.rotation_deg for error in fine), 2),
    }


def _error(row: rows.Row) -> PoseError:
    """Infinite where no pose was given."""
    if row.error_m is None or row.error_deg is None:
        return PoseError(math.inf, math.inf)
    return PoseError(row.error_m, row.error_deg)
