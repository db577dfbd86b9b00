"""Continuous mapping: five minutes at least, or SEGSLAM_SOAK_S seconds (3600 for the hour).

SEGSLAM_SOAK_S=3600 bash tools/test.sh -m slow tests/test_soak.py
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from helpers.drives import round_drive

from segslam.core.config import load_config
from segslam.core.types import Scan, Step, Trajectory
from segslam.labels.label_files import open_labels
from segslam.odometry.sweep import GivenOdometry
from segslam.output.finished import read_run
from segslam.output.log import read_log, schema
from segslam.output.log.container import messages
from segslam.run.run import Run
from segslam.scans import Dataset
from segslam.slam.slam import Slam

UNLABELLED = open_labels("none", beside=Path(), scan_names=[], encoding=None)
SECONDS = float(os.environ.get("SEGSLAM_SOAK_S", "300"))
ROUND = 51
"""Scans of the drive until it comes around."""
MOST_MB_PER_1000_KEYFRAMES = 120.0
"""60 MB per 1,000 scans of a drive, of which half at most are keyframes; here every scan is one."""
FULL = 300
"""Scans after which the caches are full: 64 keyframes ready for alignment."""


class Rounds(Dataset):
    """Repeats one round for a given time, on a slow machine for longer: until the second half has full caches."""

    name = "rounds"
    labels = UNLABELLED
    reference = None
    scan_index = np.arange(200_000)
    vertical_angle_deg = 0.0
    names: tuple[str, ...] = ()
    num_recorded = len(scan_index)

    def __init__(self, seconds: float) -> None:
        self._end = monotonic() + seconds

    def __getitem__(self, row: int) -> Scan:
        return replace(round_drive()[0][row % ROUND], index=row, stamp_ns=row * 300_000_000)

    def poses(self) -> Trajectory:
        """Given, for KISS-ICP takes ten times as long as all else and keeps no more than its local map."""
        rows = self.scan_index
        return Trajectory(rows, rows * 300_000_000, round_drive()[1].T_world_lidar[rows % ROUND])

    def until_the_end(self, steps: Iterator[Step]) -> Iterator[Step]:
        for number, step in enumerate(steps):
            yield step
            if number > 2 * FULL and monotonic() > self._end:
                return


def _rss_mb(log: Path) -> np.ndarray:
    values = [message.data for message in messages(log) if message.topic == schema.MEMORY]
    return np.array([float(data.split(b":")[1].rstrip(b"}")) for data in values])


@pytest.mark.slow
def test_continuous_mapping_has_no_leak_lag_or_lost_record(tmp_path: Path) -> None:
    rounds = Rounds(SECONDS)
    settings = ["odometry.min_range_m=1", "proximity.min_travel_m=60"]
    config = load_config(None, [*settings, "adjustment.max_minutes=0"])  # at the end, and up to an hour
    slam = Slam(config, odometry=GivenOdometry(rounds.poses(), config.odometry))
    with Run(tmp_path, slam, dataset="rounds") as run:
        steps = run.map(rounds)
        seconds = [sum(step.stage_seconds.values()) for step in rounds.until_the_end(steps)]
        steps.close()
        run.complete()
    recorded = list(read_log(tmp_path / "log.mcap").steps())
    trajectory = read_run(tmp_path).result.trajectory
    assert [step.scan_index for step in recorded] == trajectory.scan_index.tolist() == list(range(len(recorded)))
    assert len(recorded) >= len(seconds) > 2 * FULL

    rss_mb = _rss_mb(tmp_path / "log.mcap")
    half = len(rss_mb) // 2
    growth = 1000 * np.polyfit(np.arange(half, len(rss_mb)), rss_mb[half:], 1)[0]
    assert growth < MOST_MB_PER_1000_KEYFRAMES, (
        f"{growth:.0f} MB per 1,000 keyframes, {rss_mb[half]:.0f} MB at half time"
    )

    early, late = np.array_split(seconds, 5)[1], np.array_split(seconds, 5)[4]
    assert np.median(late) < 2.0 * np.median(early), "the machine's other work comes and goes; a lag doubles and stays"
