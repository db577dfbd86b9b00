"""One row per registration, written to a CSV file at once and read to resume a benchmark; statistics of rows."""

import csv
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Annotated, Any, TextIO

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from segslam.bench.experiments.pairs import ScanVariant
from segslam.core.evaluation import SUCCESS_DEG, SUCCESS_M
from segslam.core.types import SegslamError, Transform
from segslam.core.whole_files import cannot_write, whole_file

NONE_IF_EMPTY = BeforeValidator(lambda value: None if value == "" else value)
Number = Annotated[float | None, NONE_IF_EMPTY]
Count = Annotated[int | None, NONE_IF_EMPTY]


class Row(BaseModel):
    """A registration by one method; None for fields that do not apply, such as the pose of a rejected one."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pairs: str
    source: int
    target: int
    source_yaw_deg: float
    source_lost: float
    target_lost: float
    draw: int
    method: str
    accepted: bool
    reason: str
    """Reason of the rejection; empty if accepted."""
    error_m: Number = None
    error_deg: Number = None
    """Error of T_estimate inv(T_true), as in the paper."""
    num_correspondences: Count = None
    num_edges: Count = None
    num_inliers: Count = None
    ms: Number = None
    """Time of the whole registration as if it were the only one: labels by geometry, preparation, alignment."""
    cpu_ms: Number = None
    """The same as CPU time, which is independent of the load of the machine."""
    label_ms: Number = None
    prepare_ms: Number = None
    match_ms: Number = None
    refine_ms: Number = None
    verify_ms: Number = None
    peak_mb: Number = None
    """Peak of additional memory; None if unknown."""
    T_target_source: str = ""
    """First three rows of the matrix, 12 numbers; empty if rejected."""

    @property
    def success(self) -> bool:
        """True for an error below 2 m and 5 degrees, the paper's criterion."""
        if self.error_m is None or self.error_deg is None:
            return False
        return self.accepted and self.error_m < SUCCESS_M and self.error_deg < SUCCESS_DEG

    @property
    def trial_key(self) -> tuple[str, ScanVariant, ScanVariant]:
        """The key of the row's `Trial`."""
        source = ScanVariant(self.source, self.source_yaw_deg, self.source_lost, self.draw if self.source_lost else 0)
        target = ScanVariant(self.target, 0.0, self.target_lost, self.draw if self.target_lost else 0)
        return self.pairs, source, target

    @property
    def estimate(self) -> Transform | None:
        """The estimated pose."""
        if not self.T_target_source:
            return None
        return np.vstack([np.array(self.T_target_source.split(), dtype=float).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


LOST_WORKER = "worker_lost"
"""Reject reason of a row whose pair terminated every worker that tried it."""
STAGES = {
    "label_ms": "label",
    "prepare_ms": "prepare both",
    "match_ms": "match",
    "refine_ms": "refine",
    "verify_ms": "verify",
}
"""Times of the stages, and their titles in tables."""
COLUMNS = [*Row.model_fields, "success"]


def write_rows(file: Path, rows: Sequence[Row]) -> None:
    """Write a file with these rows. Raises SegslamError if it cannot be written."""
    with whole_file(file) as part, part.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerow(COLUMNS)
        _write(stream, rows)


def append_rows(file: Path, rows: Sequence[Row]) -> None:
    """Append rows to a file; they are on the disk when this returns. Raises WorkFailed on a write error."""
    try:
        with file.open("a", newline="", encoding="utf-8") as stream:
            _write(stream, rows)
    except OSError as error:
        raise cannot_write(file, error) from error


def _write(stream: TextIO, rows: Sequence[Row]) -> None:
    csv.DictWriter(stream, COLUMNS).writerows(row.model_dump() | {"success": row.success} for row in rows)


def read_rows(file: Path) -> list[Row]:
    """The rows of a file with rows. An incomplete last line is ignored.

    Raises SegslamError, naming the line, for an invalid row.
    """
    with file.open(newline="", encoding="utf-8") as stream:
        text = stream.read()
    complete = text[: text.rfind("\n") + 1].splitlines()
    rows = []
    for number, values in enumerate(csv.DictReader(complete), start=2):
        values.pop("success", None)
        try:
            rows.append(Row.model_validate(values))
        except ValidationError as error:
            first = error.errors()[0]
            raise SegslamError(f"{file}:{number}: {first['loc'][0]}: {first['msg']}; remove the line") from error
    return rows


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
