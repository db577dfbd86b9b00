"""A log with loops, shared by the tests of commands that read one."""

from pathlib import Path

import pytest
from helpers.drives import SLAM_CONFIG, drifting_slam, round_drive

from segslam.output.log import LogWriter


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a drive around a block and a bit more, with loops, not adjusted; only read."""
    scans, truth = round_drive()
    slam = drifting_slam()
    path = tmp_path_factory.mktemp("round") / "log.mcap"
    with LogWriter(path, config=SLAM_CONFIG, dataset="round", reference=truth) as log:
        for scan in scans:
            log.write(slam.process(scan))
        result = slam.finish()
        log.write_result(result.estimate, result.trajectory)
    return path
