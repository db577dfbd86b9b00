"""A run hands each scan to the odometry, with the scan after it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.drives import round_drive, write_kitti_sequence

from segslam import open_dataset
from segslam.cli.ending import summary
from segslam.core.config import Config, ProximityConfig
from segslam.core.types import BadScan, Scan, SegslamError
from segslam.odometry.sweep import GivenOdometry
from segslam.output.log import LogWriter
from segslam.run.run import Run
from segslam.scans import Dataset
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


class _Shifted(Dataset):
    """The first scans of a drive, some with another stamp: that of their own, and intervals added to it."""

    def __init__(self, shifts: dict[int, int]) -> None:
        self.scan_index = np.arange(6)
        self._shifts = shifts

    def __getitem__(self, row: int) -> Scan:
        scans = round_drive()[0]
        interval_ns = scans[1].stamp_ns - scans[0].stamp_ns
        return replace(scans[row], stamp_ns=scans[row].stamp_ns + self._shifts.get(row, 0) * interval_ns)


@pytest.mark.parametrize(
    ("shifts", "skipped"),
    [
        ({2: 10**6}, [2]),
        ({0: 10**6}, [0]),
        ({2: -2}, [2]),
        ({1: 5, 3: 9}, [1, 3]),
        ({5: 10**6}, []),  # the last one: nothing shows that it is late
    ],
)
def test_a_stamp_that_is_too_late_or_too_early_loses_its_own_scan_only(
    tmp_path: Path, shifts: dict[int, int], skipped: list[int]
) -> None:
    (tmp_path / "run").mkdir()
    slam = Slam(odometry=GivenOdometry(round_drive()[1], Config().odometry))
    with Run(tmp_path / "run", slam, dataset="made") as run:
        steps = list(run.map(_Shifted(shifts)))
    assert [row for row, step in enumerate(steps) if isinstance(step, BadScan)] == skipped
    assert len(steps) == 6


def test_scans_after_a_clock_was_set_back_are_counted_and_the_summary_names_the_stamps(tmp_path: Path) -> None:
    slam = Slam(odometry=GivenOdometry(round_drive()[1], Config().odometry))
    (tmp_path / "run").mkdir()
    with Run(tmp_path / "run", slam, dataset="made") as run:
        steps = list(run.map(_Shifted({3: -100, 4: -100, 5: -100})))
        metrics, _ = run.complete()
    assert [isinstance(step, BadScan) for step in steps] == [False] * 3 + [True] * 3
    assert (metrics["num_scans"], metrics["num_scans_skipped"], metrics["num_scans_late"]) == (3, 3, 3)
    said = summary(metrics, tmp_path / "run")
    assert "of these, 3 scans skipped: a scan before has the same stamp or a later one; correct the stamps" in said


@pytest.mark.parametrize("is_finished", [False, True])
def test_a_run_never_touches_one_that_began_in_its_folder(tmp_path: Path, is_finished: bool) -> None:
    """Two commands may find the folder empty; the second makes its log later."""
    with Run(tmp_path, Slam(), dataset="first") as first:
        next(first.map(_Shifted({})))
        if is_finished:
            first.__exit__()
        before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
        with pytest.raises(SegslamError, match="another run has begun there"):
            Run(tmp_path, Slam(Config(proximity=ProximityConfig(base_radius_m=9.0))), dataset="second")
        assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_a_log_that_is_being_written_is_not_replaced(tmp_path: Path) -> None:
    with (
        LogWriter(tmp_path / "log.mcap", config=Config(), dataset="first"),
        LogWriter(tmp_path / "log.mcap.part", config=Config(), dataset="second") as log,
    ):
        before = (tmp_path / "log.mcap").read_bytes()
        with pytest.raises(SegslamError, match="another process writes it"):
            log.move(tmp_path / "log.mcap")
        assert (tmp_path / "log.mcap").read_bytes() == before


def test_a_log_takes_a_name_that_is_free(tmp_path: Path) -> None:
    """The log that is resumed may have been removed meanwhile."""
    with LogWriter(tmp_path / "log.mcap.part", config=Config(), dataset="resumed") as log:
        log.move(tmp_path / "log.mcap")
    assert [file.name for file in tmp_path.iterdir()] == ["log.mcap"]
