"""One row per registration, written to a CSV file at once, and read to resume a benchmark."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TextIO

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from segslam.bench.experiments.trials import ScanVariant
from segslam.core.evaluation import PoseError
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
        return self.accepted and PoseError(self.error_m, self.error_deg).success

    @property
    def key(self) -> tuple[str, ScanVariant, ScanVariant, str]:
        """Identifies the trial and the method."""
        source = ScanVariant(self.source, self.source_yaw_deg, self.source_lost, self.draw if self.source_lost else 0)
        target = ScanVariant(self.target, 0.0, self.target_lost, self.draw if self.target_lost else 0)
        return self.pairs, source, target, self.method

    @property
    def estimate(self) -> Transform | None:
        """The estimated pose."""
        if not self.T_target_source:
            return None
        return np.vstack([np.array(self.T_target_source.split(), dtype=float).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


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
