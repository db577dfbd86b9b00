"""Files of a run's folder, read back."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.finished_run import make_run

from segslam.core.types import Rejected, SegslamError, Trajectory
from segslam.output.folder import POSE_COLUMNS, read_alone, write_loops, write_poses


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


def test_poses_of_kiss_icp_may_go_on_after_the_scans_of_a_run(tmp_path: Path) -> None:
    whole = make_run(tmp_path / "run").result.trajectory
    write_poses(tmp_path, "kiss_icp", whole, None)
    part = Trajectory(whole.scan_index[:3], whole.stamp_ns[:3], np.tile(np.eye(4), (3, 1, 1)))
    found = read_alone(tmp_path, part)
    assert found is not None
    np.testing.assert_allclose(found.T_world_lidar, whole.T_world_lidar[:3], atol=1e-6)
    with pytest.raises(SegslamError, match="not of the scans of this run"):
        read_alone(tmp_path, replace(part, stamp_ns=part.stamp_ns + 1_000_000))
