"""A day of NCLT: scans as the dataset stores them, their stamps and true poses."""

from pathlib import Path

import numpy as np
import pytest

from segslam.core.types import BadScan
from segslam.scans import open_dataset
from segslam.scans.records import NCLT

FIRST_US = 1_326_030_975_726_043
POINTS_M = np.array([[70.0, 1.5, -2.0], [-90.0, 90.0, 3.0], [5.0, -63.85, 0.5]])


@pytest.fixture
def day(tmp_path: Path) -> Path:
    folder = tmp_path / "2012-01-08"
    (folder / "velodyne_sync").mkdir(parents=True)
    (tmp_path / "ground_truth").mkdir()
    stored = np.zeros(len(POINTS_M), NCLT)
    for axis, column in zip("xyz", (POINTS_M * [1.0, -1.0, -1.0]).T, strict=True):
        stored[axis] = np.rint((column + 100.0) / 0.005)
    stored["intensity"] = [3, 40, 200]
    for number in range(3):
        (folder / "velodyne_sync" / f"{FIRST_US + 200_000 * number}.bin").write_bytes(stored.tobytes())
    stamps_us = FIRST_US + np.array([-1_000_000, 2_000_000])
    truth = np.column_stack([stamps_us, np.zeros((2, 6))])
    np.savetxt(tmp_path / "ground_truth" / "groundtruth_2012-01-08.csv", truth, delimiter=",", fmt="%.6f")
    return folder


def test_a_day_of_nclt_is_read_as_it_is_stored(day: Path) -> None:
    scans = open_dataset(day, dataset="nclt", labels="none", intensities=True)
    assert len(scans) == 3
    np.testing.assert_allclose(scans[0].points, POINTS_M, atol=0.003)
    assert scans[0].intensities is not None
    assert scans[0].intensities.tolist() == [3.0, 40.0, 200.0]
    assert np.abs(np.array([scan.stamp_ns for scan in scans]) / 1000 - FIRST_US - [0, 200_000, 400_000]).max() < 1.0
    assert scans.reference is not None
    assert len(scans.reference) == 3


def test_a_truncated_scan_is_skipped_by_name(day: Path) -> None:
    file = day / "velodyne_sync" / f"{FIRST_US}.bin"
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(BadScan, match=rf"{FIRST_US}\.bin: 21 bytes are not a multiple of 8 .*truncated"):
        open_dataset(day, dataset="nclt", labels="none")[0]
