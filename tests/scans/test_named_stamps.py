"""Stamps in the names of scan files."""

from pathlib import Path

import numpy as np
import pytest

from segslam.scans import open_dataset
from segslam.scans.named_stamps import stamp_of_name, stamps_of_names


@pytest.mark.parametrize(
    ("name", "stamp_ns"),
    [
        ("1700000000.25", 1_700_000_000_250_000_000),
        ("1700000000_000000001", 1_700_000_000_000_000_001),
        ("1700000000123456789", 1_700_000_000_123_456_789),
        ("1700000000123456", 1_700_000_000_123_456_000),
        ("1700000000123", 1_700_000_000_123_000_000),
        ("000123", None),
        ("scan_1700000000.25", None),
    ],
)
def test_the_name_of_a_file_can_hold_its_stamp(name: str, stamp_ns: int | None) -> None:
    assert stamp_of_name(name) == stamp_ns


def _folder(folder: Path, stems: list[str], *, suffix: str = ".bin") -> Path:
    folder.mkdir(parents=True)
    for number, stem in enumerate(stems):
        np.full((5, 4), number + 1.0, dtype=np.float32).tofile(folder / f"{stem}{suffix}")
    return folder


@pytest.mark.parametrize(
    "stems",
    [
        ["1700000000950000000", "1700000000982590000", "1700000001082591000"],  # MulRan, HeLiPR
        ["1700000000950000", "1700000000982590", "1700000001082591"],  # Boreas
        ["1700000000.95", "1700000000.98259", "1700000001.082591"],  # Python's text of a float
        ["1700000000.950000", "1700000000.982590", "1700000001.082591"],
        ["1700000000.950000000", "1700000000.982590000", "1700000001.82591000"],  # seconds and nanoseconds
        ["cloud_1700000000_950000000", "cloud_1700000000_982590000", "cloud_1700000001_82591000"],  # Newer College
        [f"n015__LIDAR_TOP__{us}.pcd" for us in (1700000000950000, 1700000000982590, 1700000001082591)],  # nuScenes
    ],
)
def test_a_folder_whose_names_are_stamps_has_these_stamps_and_their_order(tmp_path: Path, stems: list[str]) -> None:
    dataset = open_dataset(_folder(tmp_path / "drive", stems))
    assert [scan.points[0, 0] for scan in dataset] == [1.0, 2.0, 3.0]
    assert [scan.stamp_ns - 1_700_000_000_000_000_000 for scan in dataset] == [950_000_000, 982_590_000, 1_082_591_000]


@pytest.mark.parametrize(
    "stems",
    [
        ["0000000000", "0000000001", "0000000002"],  # KITTI's raw data
        ["1700000000.1", "1700000000.2", "last"],
        ["1700000000.1", "1700000000.10", "1700000000.2"],
        ["9999999999999999997", "9999999999999999998", "9999999999999999999"],
        ["front_1700000000.1", "front_1700000000.2", "rear_1700000000.3"],
    ],
)
def test_other_names_are_in_the_order_of_their_numbers(tmp_path: Path, stems: list[str]) -> None:
    dataset = open_dataset(_folder(tmp_path / "drive", stems))
    assert [scan.stamp_ns for scan in dataset] == [0, 100_000_000, 200_000_000]


def test_times_in_a_file_are_used_rather_than_those_in_names(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "drive", ["1700000000.1", "1700000000.2"])
    (folder / "times.txt").write_text("5\n6\n")
    assert [scan.stamp_ns for scan in open_dataset(folder)] == [5_000_000_000, 6_000_000_000]


def test_scans_of_mulran_have_the_stamps_of_their_names(tmp_path: Path) -> None:
    stems = ["1700000000950000000", "1700000001082591000"]
    _folder(tmp_path / "drive" / "Ouster", stems)
    pose = "1,0,0,0,0,1,0,0,0,0,1,0"
    (tmp_path / "drive" / "global_pose.csv").write_text("".join(f"{stem},{pose}\n" for stem in stems))
    assert [scan.stamp_ns for scan in open_dataset(tmp_path / "drive", dataset="mulran")] == [*map(int, stems)]


def test_no_files_have_no_stamps() -> None:
    assert stamps_of_names([]) is None
