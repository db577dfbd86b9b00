"""A run hands each scan to the odometry, with the scan after it."""

from pathlib import Path

import numpy as np
from helpers.drives import round_drive, write_kitti_sequence

from segslam import open_dataset
from segslam.core.config import Config
from segslam.core.types import BadScan, Scan
from segslam.odometry.sweep import GivenOdometry
from segslam.run.run import Run
from segslam.slam.slam import Slam


class _Noted(GivenOdometry):
    """Notes the scans that are foreseen."""

    def foresee(self, scan: Scan, *, gap: float) -> None:
        self.foreseen = [*getattr(self, "foreseen", []), (scan.index, gap)]


def test_the_odometry_knows_the_next_scan_unless_it_is_broken(tmp_path: Path) -> None:
    (write_kitti_sequence(tmp_path, num_scans=6) / "000003.bin").write_bytes(b"broken")
    odometry = _Noted(round_drive()[1], Config().odometry)
    (tmp_path / "run").mkdir()
    with Run(tmp_path / "run", Slam(odometry=odometry), dataset="made") as run:
        steps = list(run.map(open_dataset(tmp_path, labels="none")))
    assert [isinstance(step, BadScan) for step in steps] == [False, False, False, True, False, False]
    assert odometry.foreseen == [(1, 1.0), (2, 1.0), (5, 1.0)]
    np.testing.assert_array_equal([step.scan_index for step in steps if not isinstance(step, BadScan)], [0, 1, 2, 4, 5])
