"""Scans of data sets with .bin files of their own, written by the formats of their readers; and folders of a drive."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from segslam.core.types import BadScan, SegslamError
from segslam.scans import open_dataset
from segslam.scans.clouds import read_file

NUM = 64
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-20.0, 20.0, (NUM, 3)).astype(np.float32)
INTENSITIES = np.arange(NUM)
PARTS = np.linspace(0.0, 1.0, NUM)
"""Times in the sweep of a tenth of a second."""
STAMP_NS = 1_700_000_000_123_456_000


def _bytes(form: str, *columns: Sequence[float] | np.ndarray) -> bytes:
    types = [float if letter == "f" else int for letter in form]
    rows = zip(*columns, strict=True)
    return b"".join(
        struct.pack("<" + form, *(one(value) for one, value in zip(types, row, strict=True))) for row in rows
    )


NONE = np.zeros(NUM)
FILES = {
    f"sweeps/LIDAR_TOP/n015-2018-07-24+0800__LIDAR_TOP__{STAMP_NS // 1000}.pcd.bin": _bytes(
        "fffff", *POINTS.T, INTENSITIES, NONE
    ),
    f"boreas-2020/lidar/{STAMP_NS // 1000}.bin": _bytes("ffffff", *POINTS.T, INTENSITIES, NONE, 0.1 * PARTS - 0.05),
    f"LiDAR/Ouster/{STAMP_NS}.bin": _bytes("ffffIHHH", *POINTS.T, INTENSITIES, 1e8 * PARTS, NONE, NONE, NONE),
    f"LiDAR/Velodyne/{STAMP_NS}.bin": _bytes("ffffHf", *POINTS.T, INTENSITIES, NONE, 0.1 * PARTS),
    f"LiDAR/Avia/{STAMP_NS}.bin": _bytes("fffBBBI", *POINTS.T, INTENSITIES, NONE, NONE, 1e8 * PARTS),
    f"LiDAR/Aeva/{STAMP_NS}.bin": _bytes("fffffiBf", *POINTS.T, NONE, NONE, 1e8 * PARTS, NONE, INTENSITIES),
    "LiDAR/Aeva/1691936557946849179.bin": _bytes("fffffiB", *POINTS.T, INTENSITIES, NONE, 1e8 * PARTS, NONE),
    f"2012-01-08/velodyne_sync/{STAMP_NS // 1000}.bin": _bytes(
        "HHHBB", *np.rint((POINTS * [1.0, -1.0, -1.0] + 100.0) / 0.005).T, INTENSITIES, NONE
    ),
    f"robotcar/velodyne_left/{STAMP_NS // 1000}.bin": _bytes(
        "f", np.concatenate([*(POINTS * [1.0, -1.0, -1.0]).T, INTENSITIES])
    ),
}
STAMP_TIMES = {"boreas": 0.5, "LiDAR": 0.0}
"""When in the sweep the stamp is, where the points have times."""


@pytest.mark.parametrize("name", FILES)
def test_a_folder_of_scans_is_read_by_the_layout_of_its_data_set(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(parents=True)
    (file.parent.parent / "applanix").mkdir()  # of Boreas
    file.write_bytes(FILES[name])
    scan = open_dataset(file.parent, labels="none", intensities=True)[0]
    np.testing.assert_allclose(scan.points, POINTS, atol=0.003)  # NCLT: multiples of 5 mm
    np.testing.assert_allclose(scan.intensities, INTENSITIES)
    assert scan.stamp_ns in (STAMP_NS, 1691936557946849179)
    stamp_time = next((time for folder, time in STAMP_TIMES.items() if name.startswith(folder)), None)
    if stamp_time is None:
        assert len(scan.times) == 0
    else:
        np.testing.assert_allclose(scan.times, PARTS, atol=1e-6)
        assert scan.sweep_s == pytest.approx(0.1, abs=1e-6)
        assert scan.stamp_time == pytest.approx(stamp_time, abs=1e-6)


def test_a_cut_scan_is_refused_with_the_values_of_its_points(tmp_path: Path) -> None:
    for name, content in FILES.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        (file.parent.parent / "applanix").mkdir(exist_ok=True)
        for num_bytes, complaint in (
            (len(content) - 3, r"are not a multiple of \d+ \(x y z .*truncated"),
            (0, "points"),
        ):
            file.write_bytes(content[:num_bytes])
            with pytest.raises(BadScan, match=complaint):
                read_file(file)


def test_scans_of_other_names_in_such_folders_are_read_as_kittis(tmp_path: Path) -> None:
    for folder in ("LiDAR/Ouster", "velodyne_sync", "velodyne_left", "boreas/lidar"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / "boreas/applanix").mkdir(parents=True, exist_ok=True)
        np.column_stack([POINTS, INTENSITIES]).astype("<f4").tofile(tmp_path / folder / "000000.bin")
        np.testing.assert_array_equal(read_file(tmp_path / folder / "000000.bin").points, POINTS)


TIMES_S = 1_700_000_000 + 0.1 * np.arange(3)
POSE = "0 0 0 0 0 0 1"


def _drive(folder: Path, scans: str, suffix: str, content: bytes, truth: dict[str, str]) -> Path:
    (folder / scans).mkdir(parents=True)
    for time_s in TIMES_S:
        stem = f"cloud_{time_s:.0f}_{100_000_000 * round(10 * (time_s % 1))}" if suffix == ".pcd" else f"{time_s:.6f}"
        name = stem if suffix == ".pcd" else stem.replace(".", "")
        (folder / scans / f"{name}{suffix}").write_bytes(content)
    for name, text in truth.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


PCD = (
    b"VERSION 0.7\nFIELDS x y z intensity t\nSIZE 4 4 4 4 4\nTYPE F F F F U\nCOUNT 1 1 1 1 1\nWIDTH 64\nHEIGHT 1\n"
    b"POINTS 64\nDATA binary\n" + _bytes("ffffI", *POINTS.T, INTENSITIES, 1e8 * PARTS)
)
BOREAS_ROW = f"{0:.1f}" + 12 * ",0"


def test_the_folder_of_a_drive_is_recognised_and_has_true_poses(tmp_path: Path) -> None:
    boreas = _drive(
        tmp_path / "boreas-2020",
        "lidar",
        ".bin",
        FILES[f"boreas-2020/lidar/{STAMP_NS // 1000}.bin"],
        {"applanix/lidar_poses.csv": "GPSTime,easting\n" + 3 * (BOREAS_ROW + "\n")},
    )
    college = _drive(
        tmp_path / "college",
        "raw_format/ouster_scan",
        ".pcd",
        PCD,
        {"ground_truth/registered_poses.csv": "#sec,nsec,x\n" + 3 * f"1,0,{POSE.replace(' ', ',')}\n"},
    )
    mulran = _drive(
        tmp_path / "KAIST01",
        "Ouster",
        ".bin",
        np.column_stack([POINTS, INTENSITIES]).astype("<f4").tobytes(),
        {"global_pose.csv": "".join(f"{time}" + ",1,0,0,0,0,1,0,0,0,0,1,0\n" for time in (17e14, 18e14))},
    )
    for folder, kind, has_times in ((boreas, "boreas", True), (college, "ncd", True), (mulran, "mulran", False)):
        drive = open_dataset(folder, labels="none", intensities=True)
        assert drive.name == f"{kind}/{folder.name}"
        assert len(list(drive)) == 3
        assert (len(drive[0].times) > 0) == has_times
        np.testing.assert_allclose(drive[0].intensities, INTENSITIES)
        assert drive.reference is not None
        assert len(drive.reference) == 3


def test_helipr_needs_the_name_of_a_sensor(tmp_path: Path) -> None:
    name = f"LiDAR/Velodyne/{STAMP_NS}.bin"
    (tmp_path / "LiDAR/Velodyne").mkdir(parents=True)
    (tmp_path / name).write_bytes(FILES[name])
    (tmp_path / "LiDAR_GT").mkdir()
    (tmp_path / "LiDAR_GT/global_Velodyne_gt.txt").write_text(f"{STAMP_NS} {POSE}\n{STAMP_NS} {POSE}\n")
    with pytest.raises(SegslamError, match="give --sequence Ouster, Velodyne, Avia or Aeva"):
        open_dataset(tmp_path)


def test_a_drive_without_true_poses_is_refused_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "2012-01-08/velodyne_sync").mkdir(parents=True)
    with pytest.raises(SegslamError, match=r"as nclt data .*; or give the folder of the scans alone"):
        open_dataset(tmp_path / "2012-01-08")


def test_true_poses_of_another_number_than_the_scans_are_not_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Rows cannot be assigned to scans then."""
    truth = {"ground_truth/registered_poses.csv": 2 * f"1,0,{POSE.replace(' ', ',')}\n"}
    drive = open_dataset(_drive(tmp_path / "college", "raw_format/ouster_scan", ".pcd", PCD, truth))
    assert drive.reference is None
    assert "2 true poses for 3 scans are not used" in caplog.text


@pytest.mark.parametrize("suffix", [".feather", ".tfrecord", ".las", ".e57", ".xyz"])
def test_scans_of_unknown_formats_are_refused_with_the_remedy(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"1{suffix}").write_bytes(b"x")
    for data in (tmp_path, tmp_path / f"1{suffix}"):
        with pytest.raises(SegslamError, match=rf"\(only \{suffix}\); .* convert scans of another format to \.npy"):
            open_dataset(data)
