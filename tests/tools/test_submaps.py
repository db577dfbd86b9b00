"""Real submaps of sparse scans, revisited in reverse."""

from pathlib import Path

import numpy as np
import pytest

from segslam.core.config import Config
from tools.benchmarks import submaps


@pytest.mark.slow
@pytest.mark.data
def test_submaps_of_a_real_drive_close_in_reverse_and_no_others_do(data_dir: Path) -> None:
    drive = submaps.Submaps(data_dir / "nclt", Config())
    rng = np.random.default_rng(0)
    outcomes = submaps.run(drive, submaps.drive_pairs(drive.T_world_lidar, 45, rng, near=True), Config())
    assert outcomes["right"] >= 44, outcomes
    assert outcomes["wrong"] == 0, outcomes
    negatives = submaps.run(drive, submaps.drive_pairs(drive.T_world_lidar, 15, rng, near=False), Config())
    assert negatives["right"] + negatives["wrong"] == 0, negatives
