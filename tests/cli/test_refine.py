from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import drifting, round_drive

from segslam.config import load_config
from segslam.log import LogWriter, read_log
from segslam.odometry import GivenOdometry
from segslam.run.finished import read_metrics
from segslam.slam import Slam

pytestmark = pytest.mark.usefixtures("blank_reports")

CONFIG = load_config(None, ["proximity.min_travel_m=60", "adjustment.max_minutes=0"])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a drive around a block, with loops, not adjusted."""
    scans, truth = round_drive()
    slam = Slam(CONFIG, odometry=GivenOdometry(drifting(truth), CONFIG.odometry))
    path = tmp_path_factory.mktemp("run") / "log.mcap"
    with LogWriter(path, config=CONFIG, dataset="round", reference=truth) as log:
        for scan in scans:
            log.write(slam.process(scan))
        result = slam.finish()
        log.write_result(result.estimate, result.trajectory)
    return path


def test_a_run_is_refined_and_keeps_its_loops(log: Path, tmp_path: Path) -> None:
    assert run("refine", log, "--out", tmp_path / "refined", "--refine-minutes", 5, "--quiet") == 0
    metrics = read_metrics(tmp_path / "refined")
    before, after = read_log(log), read_log(tmp_path / "refined" / "log.mcap")
    first, second = before.result(), after.result()
    assert first is not None
    assert second is not None
    assert first[0].closure_weights.keys() == second[0].closure_weights.keys()
    assert before.adjustment() is None
    adjustment = after.adjustment()
    assert adjustment is not None
    assert adjustment.num_registered == metrics["num_submap_pairs"] > 0
    assert metrics["map_thickness_m"] > 0.0
    assert not np.array_equal(first[1].T_world_lidar, second[1].T_world_lidar)


def test_no_time_is_refused(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("refine", log, "--out", tmp_path / "refined", "--refine-minutes", 0) == 2
    assert "--refine-minutes" in capsys.readouterr().err
