"""Real pairs: those whose pose is known to centimetres, turned by each yaw of a full circle; those that do not overlap.

The latter are all pairs of KITTI 00, and pairs of courtyard and KITTI.
"""

from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import combinations, product
from pathlib import Path

import numpy as np

from segslam.bench.experiments import rows
from segslam.bench.experiments.rows import grouped
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import Alignment
from segslam.verification import register_prepared
from tools.benchmarks import real_pairs
from tools.benchmarks.common import PoseError, Row
from tools.benchmarks.registration.attempts import LOST, error, percent, preparer
from tools.benchmarks.registration.scans import by_shape, courtyard_points, kitti_pose, real_indices, real_scan

FAR_M = 20.0
NEAR_BOUND, FAR_BOUND = (0.3, 1.0), (0.5, 2.0)
"""m, degrees that a coarse pose may be off, up to FAR_M and beyond."""
REFINED_BOUND = (0.05, 0.2)
MEET_M = 60.0
"""Scans of KITTI 00 nearer than this share a street corner; they are not negatives."""
KITTI_ERR = 3.0, 3.0
"""m, degrees. Chosen: KITTI's ground truth errs by up to 2.2 m and 1.7 degrees between scans 3-10 and 94-95, some 80 m
apart, by three independent signs: the pairs' own poses close triangles to 0.12 m, tree by tree and corner by corner the
clouds coincide, and no point stands where the other scan saw through."""
NUM_COURTYARD = 100


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
    coarse, fine = ([_error(row) for row in by_method[name]] for name in (real_pairs.COARSE, real_pairs.REFINED))
    bound = NEAR_BOUND if apart_m <= FAR_M else FAR_BOUND
    return {
        "apart_m": round(apart_m, 1),
        "yaws": len(fine),
        "coarse_percent": percent([error.within(*bound) for error in coarse]),
        "coarse_worst_m": round(max(error.translation_m for error in coarse), 3),
        "coarse_worst_deg": round(max(error.rotation_deg for error in coarse), 2),
        "refined_percent": percent([error.within(*REFINED_BOUND) for error in fine]),
        "refined_worst_m": round(max(error.translation_m for error in fine), 3),
        "refined_worst_deg": round(max(error.rotation_deg for error in fine), 2),
    }


def _error(row: rows.Row) -> PoseError:
    """Infinite where no pose was given."""
    return LOST if row.error_m is None or row.error_deg is None else PoseError(row.error_m, row.error_deg)


def real_negatives(data: Path, config: Config, *, every: int) -> list[Row]:
    """A row for each kind of pair; of the courtyard's scans each `every`-th takes part."""
    kitti = preparer(by_shape(lambda index: real_scan(data, index).points), config)
    court = preparer(by_shape(partial(courtyard_points, data)), config)
    indices = real_indices(data)
    within: Counter[str] = Counter()
    for source, target in combinations(indices, 2):
        T_true = kitti_pose(data, source, target)
        if geometry.distance(T_true) < MEET_M:
            continue
        outcome = register_prepared(kitti(source), kitti(target), config=config)
        if not isinstance(outcome, Alignment):
            within[outcome.reason.value] += 1
        elif error(outcome.fine, T_true).within(*KITTI_ERR):
            within["right after all"] += 1
        else:
            within["accepted"] += 1
    across: Counter[str] = Counter()
    for source, target in product(range(0, NUM_COURTYARD, every), indices):
        outcome = register_prepared(court(source), kitti(target), config=config)
        across["accepted" if isinstance(outcome, Alignment) else outcome.reason.value] += 1
    return [_row("KITTI 00, over 60 m apart", within), _row("courtyard and KITTI 00", across)]


def _row(name: str, outcomes: Counter[str]) -> Row:
    return {
        "pairs": name,
        "negatives": outcomes.total() - outcomes["right after all"],
        "accepted": outcomes["accepted"],
        "right_after_all": outcomes["right after all"],
        "reasons": ", ".join(f"{reason} {count}" for reason, count in outcomes.most_common()),
    }
