"""Real drives with default settings, with and without failures of KISS-ICP."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run

from segslam.core.config import Config
from segslam.core.evaluation import trajectory_metrics
from segslam.odometry import CheckedOdometry, KissOdometry
from segslam.output.finished import read_run
from segslam.scans import open_dataset
from segslam.verification import register

FIRST_SLIP = range(80)  # KISS-ICP loses 20 degrees of a turn at scan 67, if it began at scan 0
EVERY_THIRD = range(0, 100, 3)  # turns of up to 95 degrees between scans


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("rows", [FIRST_SLIP, EVERY_THIRD])
def test_a_slip_of_kiss_icp_in_the_courtyard_is_repaired(data_dir: Path, rows: range) -> None:
    dataset = open_dataset(data_dir / "courtyard")
    assert dataset.reference is not None
    truth = dataset.reference.T_world_lidar[list(rows)]
    config = Config()
    plain = KissOdometry(config.odometry)
    checked = CheckedOdometry(KissOdometry(config.odometry), config, recover=partial(register, config=config))
    errors_m = [
        trajectory_metrics(np.stack([odometry.register(dataset[row]).T_odom_lidar for row in rows]), truth)["ate_m"]
        for odometry in (plain, checked)
    ]
    assert errors_m[0] > 0.3, "the slip"
    assert errors_m[1] < 0.1


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("drive", "ate_m"), [("courtyard", 0.1), ("nclt", 1.0)])
def test_a_drive_where_kiss_icp_fails_is_mapped(data_dir: Path, tmp_path: Path, drive: str, ate_m: float) -> None:
    assert run("map", data_dir / drive, "--out", tmp_path / "run", "--quiet") == 0
    metrics = read_run(tmp_path / "run").metrics
    assert metrics["ate_m"] < ate_m
    assert metrics.get("num_loops_false", 0) == 0
    assert metrics.get("loop_recall", 1.0) >= 0.8
