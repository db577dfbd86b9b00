"""Data, methods and settings of a benchmark, and its two units of work: prepare a scan, register a pair."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from segslam.bench.experiments.baselines import Estimate
from segslam.bench.experiments.methods import METHODS, Cost, Parts, measured, prepare_parts
from segslam.bench.experiments.pairs import ScanVariant, Trial
from segslam.bench.experiments.rows import Row
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.threads import Stopwatch
from segslam.core.types import BadScan, Labels, Points, Rejected
from segslam.labels import geometric_labels
from segslam.scans import Dataset, DataSource

logger = logging.getLogger(__name__)

LABELS = "labels"
BAD_SCAN = "bad_scan"
"""Reject reason of a row whose scan cannot be read."""

_DONE_ONCE: set[object] = set()
"""Work that this process has done before, unmeasured."""


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """Everything that the trials of a benchmark have in common; sent to the workers."""

    source: DataSource
    methods: tuple[str, ...]
    config: Config


def shared_scan(job: Job, variant: ScanVariant) -> Parts | None:
    """Read, rotate, label and prepare a scan, and remove some labels; None if the scan cannot be used.

    Geometric labels are those of rotated points. The cost of labels that are not from files is that of part LABELS.
    """
    dataset, row_of_scan = open_once(job.source)
    try:
        scan = dataset[row_of_scan[variant.index]]
    except BadScan as error:
        logger.warning("scan %d skipped: %s", variant.index, error)
        return None
    points, labels = variant.turned(scan.points), scan.labels

    def prepare(labels: Labels) -> Parts:
        return prepare_parts(points, variant.remaining(labels), methods=job.methods, config=job.config)

    _do_once(job.methods, lambda: prepare(geometric_labels(points)))
    with measured() as cost:
        is_computed = callable(labels)
        if callable(labels):
            labels = labels()
        elif is_computed := dataset.labels.geometric and not labels.any():
            labels = geometric_labels(points)
    values, costs = prepare(labels)
    return values, costs | ({LABELS: cost} if is_computed else {})


def points_of(source: DataSource, variant: ScanVariant) -> Points:
    """The points (n, 3) of a variant, as the methods receive them."""
    dataset, row_of_scan = open_once(source)
    scan = dataset[row_of_scan[variant.index]]
    return variant.turned(scan.points)


def register_trial(job: Job, trial: Trial, source: Parts | None, target: Parts | None) -> list[Row]:
    """Rows of all methods of the job for one pair, from the same prepared scans."""
    if source is None or target is None:
        return [failed_row(method, trial, BAD_SCAN) for method in job.methods]
    return [_register(method, job.config, trial, (source, target)) for method in job.methods]


@lru_cache(maxsize=4)
def open_once(source: DataSource) -> tuple[Dataset, dict[int, int]]:
    """The data set, opened once per process, and the row of each scan."""
    dataset = source.open()
    return dataset, {int(index): row for row, index in enumerate(dataset.scan_index)}


def _do_once(name: object, work: Callable[[], object]) -> None:
    """Do work unless this process has done it: the first time loads modules and compiled code, for up to seconds."""
    if name not in _DONE_ONCE:
        work()
        _DONE_ONCE.add(name)


def _register(method: str, config: Config, trial: Trial, both: tuple[Parts, Parts]) -> Row:
    align, watch = METHODS[method].align, Stopwatch()
    _do_once(method, lambda: align(both[0][0], both[1][0], config, Stopwatch()))
    with measured() as cost:
        outcome = align(both[0][0], both[1][0], config, watch)
    parts = METHODS[method].parts
    costs = [costs_of[name] for _, costs_of in both for name in parts]
    uses_labels = any(part.endswith("description") for part in parts)
    labelled = [costs_of[LABELS] for _, costs_of in both if LABELS in costs_of and uses_labels]
    reason = outcome.reason.value if isinstance(outcome, Rejected) else ""
    return failed_row(method, trial, reason).model_copy(
        update=_times(cost, costs, labelled, watch) | ({} if isinstance(outcome, Rejected) else _found(outcome, trial))
    )


def _times(aligned: Cost, prepared: list[Cost], labelled: list[Cost], watch: Stopwatch) -> dict[str, float | None]:
    """The columns of a row for time and memory."""
    costs = [aligned, *prepared, *labelled]
    return {
        "ms": 1000 * sum(cost.seconds for cost in costs),
        "cpu_ms": 1000 * sum(cost.cpu_seconds for cost in costs),
        "label_ms": 1000 * sum(cost.seconds for cost in labelled) if labelled else None,
        "prepare_ms": 1000 * sum(cost.seconds for cost in prepared),
        "peak_mb": max((cost.peak_mb for cost in costs if cost.peak_mb is not None), default=None),
    } | {f"{stage}_ms": 1000 * seconds for stage, seconds in watch.seconds.items()}


def _found(estimate: Estimate, trial: Trial) -> dict[str, object]:
    T_error = estimate.T_target_source @ geometry.inverse(trial.T_target_source)
    return {
        "accepted": True,
        "error_m": geometry.distance(T_error),
        "error_deg": math.degrees(geometry.angle(T_error)),
        "num_correspondences": estimate.num_correspondences,
        "num_edges": estimate.num_edges,
        "num_inliers": estimate.num_inliers,
        "T_target_source": " ".join(f"{value:.9g}" for value in estimate.T_target_source[:3].ravel()),
    }


def failed_row(method: str, trial: Trial, reason: str) -> Row:
    """The row of a registration without pose."""
    return Row(
        pairs=trial.pairs,
        source=trial.source.index,
        target=trial.target.index,
        source_yaw_deg=trial.source.yaw_deg,
        source_lost=trial.source.lost,
        target_lost=trial.target.lost,
        draw=max(trial.source.draw, trial.target.draw),
        method=method,
        accepted=False,
        reason=reason,
    )
