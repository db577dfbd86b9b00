"""Files of a run's folder, read back."""

import csv
from pathlib import Path

import numpy as np
from helpers.finished_run import make_run

from segslam.core.types import Rejected
from segslam.output.folder import POSE_COLUMNS, write_loops


def test_loops_csv_has_a_row_for_every_attempt(tmp_path: Path) -> None:
    result = make_run(tmp_path / "run").result
    attempts, weights = result.attempts, result.estimate.closure_weights
    write_loops(tmp_path / "loops.csv", attempts, weights)
    with (tmp_path / "loops.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(attempts) > 0
    for row, attempt in zip(rows, attempts, strict=True):
        assert int(row["source"]) == attempt.candidate.source_id
        if isinstance(attempt.outcome, Rejected):
            assert row["outcome"] == attempt.outcome.reason
            assert row["T00"] == ""
        else:
            matrix = np.array([float(row[column]) for column in POSE_COLUMNS]).reshape(4, 4)
            np.testing.assert_array_equal(matrix, attempt.outcome.T_target_source)
            assert 0 <= float(row["weight"]) <= 1
