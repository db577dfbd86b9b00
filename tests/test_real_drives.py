"""Real drives with default settings, with and without failures of KISS-ICP."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.evaluation import trajectory_metrics
from segslam.odometry.checked import CheckedOdometry
from segslam.odometry.kiss import KissOdometry
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


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("first", "missing"), [(100, 30), (300, 60), (450, 60), (400, 80)])
def test_the_error_of_the_motion_while_scans_were_missing_is_within_its_covariance(
    data_dir: Path, first: int, missing: int
) -> None:
    """Metres from the last scan (a person stood still) or 50 of them, where no scan shows the same place."""
    dataset = open_dataset(data_dir / "nclt")
    assert dataset.reference is not None
    config = Config()
    odometry = CheckedOdometry(KissOdometry(config.odometry), config, recover=partial(register, config=config))
    for row in range(first - 50, first):
        before = odometry.register(dataset[row])
    after = odometry.register(dataset[first + missing])
    T_true = geometry.inverse(dataset.reference.T_world_lidar[first - 1])
    T_true = T_true @ dataset.reference.T_world_lidar[first + missing]
    T_found = geometry.inverse(before.T_odom_lidar) @ after.T_odom_lidar
    assert after.motion is not None
    assert after.motion.covariance is not None
    error_m = T_found[:3, 3] - T_true[:3, 3]
    sigma_m = np.sqrt(np.linalg.eigvalsh(after.motion.covariance[3:, 3:])[-1])
    assert np.linalg.norm(error_m) < 3.0 * max(sigma_m, 0.1)
