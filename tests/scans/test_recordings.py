"""Everything that kiss_icp reads, as scans, and its ways of failing, as errors."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import numpy as np
import open3d as o3d
import pytest
from helpers.recorded_drive import CLOUD, TOPIC, write_mcap

from segslam.core import geometry
from segslam.core.pose_files import write_kitti
from segslam.core.types import BadScan, Label, SegslamError
from segslam.scans import open_dataset
from segslam.scans.clouds import read_file
from segslam.scans.dataset import Cloud
from segslam.scans.messages import InOrder


def _write_clouds(folder: Path, num_clouds: int) -> Path:
    """.bin clouds whose scan n has n + 3 points, all at x = n + 1."""
    folder.mkdir(parents=True)
    for number in range(num_clouds):
        points = np.ones((number + 3, 4), dtype=np.float32)
        points[:, 0] = number + 1
        points.tofile(folder / f"cloud_{number}.bin")
    return folder


def test_folder_of_clouds_is_detected(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    dataset = open_dataset(_write_clouds(tmp_path / "drive", 12))
    assert dataset.name == "generic/drive"
    assert [scan.index for scan in dataset] == list(range(12))
    assert [scan.points[0, 0] for scan in dataset] == list(range(1, 13))  # 10 comes after 9, not after 1
    assert dataset[3].stamp_ns == 300_000_000
    assert dataset.reference is None
    assert dataset.labels.geometric
    assert dataset[0].points.dtype == np.float32
    assert capsys.readouterr().out == ""  # kiss_icp prints, standard output is ours


def test_scans_can_be_read_in_two_threads_while_a_program_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Replacing standard output while a scan is read loses all that follows: the thread that ends last restores it."""
    dataset = open_dataset(_write_clouds(tmp_path / "drive", 2))
    both = Barrier(2, timeout=20.0)

    def read(file: Path) -> Cloud:
        both.wait()
        print("reading")
        if file.stem == "cloud_1":
            first_read.result()
        return read_file(file)

    monkeypatch.setattr("segslam.scans.recordings.read_file", read)
    with ThreadPoolExecutor(2) as threads:
        first_read = threads.submit(dataset.__getitem__, 0)
        assert len(threads.submit(dataset.__getitem__, 1).result().points) == 4
    print("after")
    assert capsys.readouterr().out.split() == ["reading", "reading", "after"]


def test_times_poses_and_labels_beside_velodyne_belong_to_its_clouds(tmp_path: Path) -> None:
    _write_clouds(tmp_path / "velodyne", 3)
    poses = np.array([geometry.transform(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 1.0, 3.0)])
    write_kitti(tmp_path / "poses.txt", poses)
    (tmp_path / "times.txt").write_text("5.0\n5.5\n6.0\n")
    (tmp_path / "labels").mkdir()
    np.full(4, 40, dtype="<u4").tofile(tmp_path / "labels" / "cloud_1.label")
    for folder in (tmp_path, tmp_path / "velodyne"):
        dataset = open_dataset(folder, frames="1:")
        assert len(dataset) == 2
        assert dataset[1].stamp_ns == 6_000_000_000
        np.testing.assert_array_equal(dataset[0].labels, [Label.ROAD] * 4)
        assert dataset.reference is not None
        np.testing.assert_array_equal(dataset.reference.scan_index, [1, 2])
        np.testing.assert_array_equal(dataset.reference.stamp_ns, [5_500_000_000, 6_000_000_000])
        np.testing.assert_allclose(dataset.reference.T_world_lidar, poses[1:])


def test_point_clouds_with_times_keep_them_from_0_to_1(tmp_path: Path) -> None:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.eye(3, dtype=np.float32) * 4))
    cloud.point["time"] = o3d.core.Tensor(np.array([[10.0], [30.0], [20.0]], dtype=np.float32))
    o3d.t.io.write_point_cloud(str(tmp_path / "0.ply"), cloud)
    scan = open_dataset(tmp_path)[0]
    np.testing.assert_allclose(scan.points, np.eye(3) * 4)
    np.testing.assert_allclose(scan.times, [0.0, 1.0, 0.5])


def test_one_broken_cloud_is_a_bad_scan(tmp_path: Path) -> None:
    folder = _write_clouds(tmp_path / "drive", 3)
    (folder / "cloud_1.bin").write_bytes(b"x" * 20)
    dataset = open_dataset(folder)
    with pytest.raises(BadScan, match=r"cloud_1\.bin: 20 bytes are not a multiple of 16"):
        dataset[1]
    assert [scan.index for scan in dataset] == [0, 2]


def test_named_data_set_brings_its_own_truth_and_times(tmp_path: Path) -> None:
    """MulRan as published: Ouster/STAMP.bin of 64 x 1024 points, global_pose.csv of the base."""
    (tmp_path / "Ouster").mkdir()
    for stamp in (1_000_000_000, 1_100_000_000):
        np.ones((64 * 1024, 4), dtype=np.float32).tofile(tmp_path / "Ouster" / f"{stamp}.bin")
    rows = [[stamp, *np.eye(4)[:3].ravel()] for stamp in (1_000_000_000, 1_100_000_000)]
    (tmp_path / "global_pose.csv").write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    dataset = open_dataset(tmp_path, dataset="mulran")
    assert dataset.reference is not None
    assert len(dataset) == len(dataset.reference) == 2
    scan = dataset[0]
    assert len(scan.times) == len(scan.points) == 64 * 1024
    assert (scan.times.min(), scan.times.max()) == (0.0, 1023 / 1024)


class _InOrder:
    """A recording that is read in order; its third message is unreadable."""

    is_sequential = True

    def __init__(self) -> None:
        self._raw = InOrder(lambda: iter(range(5)), 5, num_bytes=1000)

    def __len__(self) -> int:
        return 5

    def __getitem__(self, index: int) -> Cloud:
        number = self._raw[index]
        if number == 2:
            raise ValueError("broken message")
        return Cloud(np.full((2, 3), number + 1.0), stamp_ns=10**9 * (100 + number))


def test_recording_read_in_order_gives_the_requested_scan(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("segslam.scans.recordings._loader", lambda *_: _InOrder())
    dataset = open_dataset(tmp_path, dataset="rosbag", frames="3:")
    assert [(scan.index, scan.points[0, 0], scan.stamp_ns) for scan in dataset] == [
        (3, 4.0, 103_000_000_000),
        (4, 5.0, 104_000_000_000),
    ]
    whole = open_dataset(tmp_path, dataset="rosbag")
    assert [scan.index for scan in whole] == [0, 1, 3, 4]
    assert whole[1].points[0, 0] == 2.0  # back to the start


def test_times_of_another_number_are_refused(tmp_path: Path) -> None:
    folder = _write_clouds(tmp_path / "drive", 3)
    (folder / "times.txt").write_text("0\n1\n")
    with pytest.raises(SegslamError, match=r"times\.txt: 2 lines, but the data has 3 scans"):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({}, "found neither sequences/ nor velodyne/"),
        ({"dataset": "lidar9000"}, "--dataset lidar9000: no such kind of data; known: apollo, .*kitti"),
        ({"dataset": "generic"}, "the reader for generic data finds no scan in it"),
        ({"dataset": "helipr", "sequence": "Nope"}, "cannot be opened as helipr data"),
        ({"dataset": "nuscenes"}, "cannot be opened as nuscenes data .*nuscenes-devkit"),
        ({"dataset": "kitti"}, "sequences/00: no such sequence"),
    ],
)
def test_folder_that_cannot_be_opened_is_reported_with_the_reason(
    tmp_path: Path, options: dict[str, str], complaint: str
) -> None:
    with pytest.raises(SegslamError, match=complaint):
        open_dataset(tmp_path, **options)  # type: ignore[arg-type]


def test_missing_path_and_unknown_file_are_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no scans")
    with pytest.raises(SegslamError, match="nowhere: no such file or folder"):
        open_dataset(tmp_path / "nowhere")
    with pytest.raises(SegslamError, match=r"notes\.txt: found neither"):
        open_dataset(tmp_path / "notes.txt")


@pytest.mark.data
def test_courtyard_opens_with_its_stamps_and_poses(data_dir: Path) -> None:
    dataset = open_dataset(data_dir / "courtyard")
    assert dataset.reference is not None
    assert len(dataset) == len(dataset.reference) == 100
    assert dataset[1].stamp_ns == 499_457_000
    assert len(dataset[99].points) > 1000


def _write_raw(folder: Path, numbers: tuple[int, ...]) -> Path:
    """The layout of a drive of KITTI's raw data, or of KITTI-360."""
    (folder / "velodyne_points" / "data").mkdir(parents=True)
    for number in numbers:
        np.full((5, 4), number + 1.0, np.float32).tofile(folder / f"velodyne_points/data/{number:010d}.bin")
    dates = "".join(f"2011-09-30 12:40:{25 + row}.072360123\n" for row in range(4))
    (folder / "velodyne_points" / "timestamps.txt").write_text(dates)
    return folder


@pytest.mark.parametrize("place", ["", "velodyne_points", "velodyne_points/data"])
def test_a_drive_of_kittis_raw_data_has_its_dates_though_scans_are_missing(tmp_path: Path, place: str) -> None:
    drive = _write_raw(tmp_path / "2011_09_30_drive_0016_sync", (0, 1, 3))
    dataset = open_dataset(drive / place)
    assert dataset.name == "generic/2011_09_30_drive_0016_sync"
    first_ns = 1_317_386_425_072_360_123
    assert [scan.stamp_ns - first_ns for scan in dataset] == [0, 1_000_000_000, 3_000_000_000]


def test_dates_that_do_not_belong_to_the_scans_are_named(tmp_path: Path) -> None:
    drive = _write_raw(tmp_path / "drive", (0, 5))
    with pytest.raises(SegslamError, match=r"timestamps\.txt: has no line for 0000000005\.bin"):
        open_dataset(drive)
    (drive / "velodyne_points" / "timestamps.txt").write_text("never\n" * 6)
    with pytest.raises(SegslamError, match=r"timestamps\.txt:1: never is no date and time; correct the line"):
        open_dataset(drive)


def _write_ply(file: Path, fields: str, *rows: str) -> None:
    properties = "".join(f"property float {name}\n" for name in fields)
    file.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{properties}end_header\n" + "".join(f"{r}\n" for r in rows)
    )


def test_a_folder_of_two_kinds_of_scans_is_refused(tmp_path: Path) -> None:
    np.ones((10, 4), np.float32).tofile(tmp_path / "0.bin")
    np.ones((10, 4), np.float32).tofile(tmp_path / "1.bin")
    _write_ply(tmp_path / "2.ply", "xyz", "1 2 3")
    with pytest.raises(SegslamError, match=r"2 kinds of scans \(\.bin 2, \.ply 1\); put each kind into its own folder"):
        open_dataset(tmp_path)


def test_endings_in_capitals_are_the_same(tmp_path: Path) -> None:
    (tmp_path / "drive").mkdir()
    for name in ("0.PCD", "1.pcd"):
        header = (
            "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"
        )
        (tmp_path / "drive" / name).write_text(f"{header}1 2 3\n")
    assert [scan.points.tolist() for scan in open_dataset(tmp_path / "drive")] == [[[1.0, 2.0, 3.0]]] * 2
    drive = ((10**9, np.ones(5, CLOUD)),)
    assert len(open_dataset(write_mcap(tmp_path / "DRIVE.MCAP", drive), topic=TOPIC)) == 1


def test_a_ply_without_positions_is_named(tmp_path: Path) -> None:
    _write_ply(tmp_path / "0.ply", "ab", "1 2")
    _write_ply(tmp_path / "1.ply", "xyz", "1 2 3", "2 3 4")
    scans = open_dataset(tmp_path)
    assert len(scans[1].points) == 2
    with pytest.raises(BadScan, match=r"0\.ply: .*no fields x y z, only a b"):
        scans[0]


def test_fields_as_cloudcompare_names_them_are_read(tmp_path: Path) -> None:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "scalar_Intensity", "scalar_time"))
    header = f"ply\nformat ascii 1.0\ncomment Created by CloudCompare\nelement vertex 2\n{names}end_header\n"
    (tmp_path / "0.ply").write_text(header + "1 2 3 0.5 0.00\n2 3 4 0.25 0.10\n")
    scan = open_dataset(tmp_path, intensities=True)[0]
    assert scan.intensities is not None
    assert (scan.intensities.tolist(), scan.times.tolist()) == ([0.5, 0.25], [0.0, 1.0])


def test_a_folder_of_scans_has_no_topics(tmp_path: Path) -> None:
    np.ones((10, 4), np.float32).tofile(tmp_path / "0.bin")
    with pytest.raises(SegslamError, match="--topic /points: only recordings have topics"):
        open_dataset(tmp_path, topic="/points")


def test_poses_of_another_number_than_the_scans_are_refused(tmp_path: Path) -> None:
    for number in range(4):
        np.ones((10, 4), np.float32).tofile(tmp_path / f"{number}.bin")
    write_kitti(tmp_path / "poses.txt", np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(SegslamError, match=r"poses\.txt: 2 lines, but the data has 4"):
        open_dataset(tmp_path)


def test_the_home_of_an_unknown_user_is_refused() -> None:
    with pytest.raises(SegslamError, match="~unknown-user/scans: there is no user with this name"):
        open_dataset("~unknown-user/scans")
