"""KITTI's folders: numbers, stamps, frames, the vertical angle, labels in step, and every kind of bad input."""

import logging
from pathlib import Path

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.geometry import raise_beams
from segslam.core.pose_files import read_poses
from segslam.core.trajectory import camera_from_lidar
from segslam.core.types import BadScan, Label, SegslamError
from segslam.scans import Dataset, open_dataset
from segslam.scans.dataset import read_stamps, selected_rows
from segslam.scans.kitti import read_calibration, read_returns

T_CAMERA_LIDAR = geometry.transform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.0, -0.08, -0.27])
)


def _line(T_a_b: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in T_a_b[:3].ravel())


def _write_sequence(data: Path, numbers: list[int]) -> Path:
    """A sequence whose scan n has n + 5 points, the stamp n / 10 s and the camera n metres ahead."""
    folder = data / "sequences" / "03"
    (folder / "velodyne").mkdir(parents=True)
    (data / "poses").mkdir()
    rng = np.random.default_rng(0)
    for number in numbers:
        points = rng.uniform(-20, 20, (number + 5, 4)).astype(np.float32)
        points.tofile(folder / "velodyne" / f"{number:06d}.bin")
    num_rows = max(numbers) + 1
    (folder / "times.txt").write_text("".join(f"{number / 10:.6e}\n" for number in range(num_rows)))
    (folder / "calib.txt").write_text(f"P0: {_line(np.eye(4))}\nTr: {_line(T_CAMERA_LIDAR)}\n")
    ahead = [geometry.transform(np.eye(3), np.array([0.0, 0.0, number])) for number in range(num_rows)]
    (data / "poses" / "03.txt").write_text("".join(_line(pose) + "\n" for pose in ahead))
    return folder


def _open(data: Path, **options: str) -> Dataset:
    return open_dataset(data, **{"sequence": "3", "labels": "none", **options})  # type: ignore[arg-type]


def test_scan_number_is_the_files_and_leads_to_its_stamp_and_pose(tmp_path: Path) -> None:
    _write_sequence(tmp_path, [0, 1, 4, 12])
    dataset = _open(tmp_path)
    assert dataset.name == "kitti/03"
    assert [scan.index for scan in dataset] == [0, 1, 4, 12]
    assert [scan.stamp_ns for scan in dataset] == [0, 100_000_000, 400_000_000, 1_200_000_000]
    assert [len(scan.points) for scan in dataset] == [5, 6, 9, 17]
    assert dataset.reference is not None
    np.testing.assert_array_equal(dataset.reference.scan_index, [0, 1, 4, 12])
    # the camera's z is the LiDAR's x
    np.testing.assert_allclose(dataset.reference.T_world_lidar[:, 0, 3], [0, 1, 4, 12], atol=1e-12)


def test_poses_return_to_the_cameras_frame(tmp_path: Path) -> None:
    _write_sequence(tmp_path, [0, 2])
    dataset = _open(tmp_path)
    assert dataset.reference is not None
    assert dataset.T_camera_lidar is not None
    cameras = camera_from_lidar(dataset.reference.T_world_lidar, dataset.T_camera_lidar)
    np.testing.assert_allclose(cameras, read_poses(tmp_path / "poses" / "03.txt").T_a_b[[0, 2]], atol=1e-12)


@pytest.mark.parametrize(
    ("frames", "numbers"),
    [
        ("0:2", [0, 1]),
        ("1:12", [1, 4]),
        (":5", [0, 1, 4]),
        ("4:", [4, 12]),
        (":", [0, 1, 4, 12]),
        ("0:12:2", [0, 4]),
        ("1::3", [1, 4]),
        ("::1", [0, 1, 4, 12]),
    ],
)
def test_frames_select_by_number_without_the_last(tmp_path: Path, frames: str, numbers: list[int]) -> None:
    _write_sequence(tmp_path, [0, 1, 4, 12])
    dataset = _open(tmp_path, frames=frames)
    assert [scan.index for scan in dataset] == numbers
    assert dataset.reference is not None
    np.testing.assert_array_equal(dataset.reference.scan_index, numbers)


@pytest.mark.parametrize(
    ("frames", "complaint"),
    [
        ("5", "A:B"),
        ("a:b", "A:B"),
        ("1:2:3:4", "A:B"),
        ("0:9:0", "STEP must be"),
        ("2:4:9", "no such scan"),
        ("20:30", r"no such scan, only 0 to 12"),
        ("4:4", "selects no scan"),
    ],
)
def test_frames_that_select_nothing_are_refused(tmp_path: Path, frames: str, complaint: str) -> None:
    _write_sequence(tmp_path, [0, 1, 4, 12])
    with pytest.raises(SegslamError, match=complaint):
        _open(tmp_path, frames=frames)


def test_sequence_folder_opens_by_itself(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0, 1])
    dataset = open_dataset(folder, labels="none")
    assert dataset.name == "kitti/03"
    assert dataset.reference is not None


def test_without_poses_there_is_no_reference(tmp_path: Path) -> None:
    _write_sequence(tmp_path, [0])
    (tmp_path / "poses" / "03.txt").unlink()
    assert _open(tmp_path).reference is None


def test_poses_of_another_length_than_the_times_are_refused(tmp_path: Path) -> None:
    _write_sequence(tmp_path, [0, 1, 4])
    (tmp_path / "poses" / "03.txt").write_text(f"{_line(np.eye(4))}\n" * 2)
    with pytest.raises(SegslamError, match=r"03\.txt: 2 lines, but the data has 5 scans; it must have one line"):
        _open(tmp_path)


def test_a_file_of_three_values_per_point_is_rejected(tmp_path: Path) -> None:
    """Even where its length fits: read by fours, x, y and z fall into every column by turns."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12_000, 3)) * [20.0, 12.0, 0.8]
    for values, name in ((points, "three"), (np.column_stack([points, points[:, :2]]), "five")):
        file = tmp_path / f"{name}.bin"
        values.astype("<f4").tofile(file)
        assert file.stat().st_size % 16 == 0
        with pytest.raises(BadScan, match="does not have 4 values per point"):
            read_returns(file)
    file = tmp_path / "four.bin"
    np.column_stack([points, rng.uniform(size=12_000)]).astype("<f4").tofile(file)
    assert len(read_returns(file)) == 12_000


def test_values_of_float64_are_rejected_and_odd_ones_of_float32_are_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    file = tmp_path / "000000.bin"
    points = (rng.normal(size=(12_000, 4)) * [20.0, 12.0, 0.8, 1.0]).astype(np.float32)
    missing = points.astype(float)
    missing[::2] = np.nan
    for values in (points, points[:20], points[:, :3], 1e-3 * rng.integers(-20_000, 20_000, size=(9000, 5)), missing):
        values.astype("<f8").tofile(file)
        with pytest.raises(BadScan, match=r"000000\.bin: its values are not float32 .* but like float64; .*<f8"):
            read_returns(file)
    flat, dark, far = points.copy(), points.copy(), points.copy()
    flat[:, 2] = 1e-17 * points[:, 0]
    dark[:, 3] = 0.0
    far[::2, :3] = np.finfo(np.float32).max
    wall = np.column_stack([points[:, 0], np.ones_like(points[:, :2]), points[:, 2]])[:, [0, 1, 3, 2]]
    for values in (flat, dark, far, wall, points[:1], np.zeros((5, 4), np.float32)):
        values.astype("<f4").tofile(file)
        assert len(read_returns(file)) == len(values)


@pytest.mark.parametrize("num_points", [300, 3000, 30_000])
def test_four_columns_of_one_distribution_are_read(tmp_path: Path, num_points: int) -> None:
    file = tmp_path / "000000.bin"
    for seed in range(10):
        np.random.default_rng(seed).normal(size=(num_points, 4)).astype("<f4").tofile(file)
        assert len(read_returns(file)) == num_points


@pytest.mark.data
@pytest.mark.parametrize("order", ["as recorded", "shuffled"])
@pytest.mark.parametrize("scale", [1.0, 255.0])
@pytest.mark.parametrize("num", [3, 4, 5, 6, 7])
def test_the_values_per_point_of_real_scans_are_found(
    data_dir: Path, tmp_path: Path, num: int, scale: float, order: str
) -> None:
    """As nuScenes' files: x y z intensity ring; and those with times and normals."""
    rng = np.random.default_rng(0)
    sources = [
        *sorted((data_dir / "courtyard/velodyne").glob("*0.bin")),
        *sorted((data_dir / "kitti/sequences/00/velodyne").glob("*.bin"))[:3],
    ]
    file = tmp_path / "000000.pcd.bin"
    for source in sources:
        points = np.fromfile(source, "<f4").reshape(-1, 4)
        points = points[: len(points) // 20 * 20]  # any number of values fits the size of the file
        if order == "shuffled":
            points = rng.permutation(points)
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        ring = np.round(40.0 * (elevation - elevation.min()))
        share = points[:, 3] / max(points[:, 3].max(), 1.0)
        times, last = np.linspace(0.0, 0.1, len(points)), rng.uniform(size=len(points))
        columns = [points[:, :3], scale * share, ring, times, last]
        np.column_stack(columns)[:, :num].astype("<f4").tofile(file)
        if num == 4:
            assert len(read_returns(file)) == len(points)
            continue
        with pytest.raises(BadScan, match=rf"does not have 4 values per point .* but {num}; .*\(-1, {num}\)"):
            read_returns(file)


@pytest.mark.data
def test_points_that_alternate_between_opposite_sides_are_read(data_dir: Path, tmp_path: Path) -> None:
    """As those of two sensors in turn: neighbours in the file differ more than other points."""
    for source in sorted((data_dir / "kitti/sequences/00/velodyne").glob("*.bin"))[:5]:
        points = np.fromfile(source, "<f4").reshape(-1, 4)
        points = points[: len(points) // 420 * 420]  # any number of values fits the size of the file
        by_azimuth = np.argsort(np.arctan2(points[:, 1], points[:, 0])).reshape(2, -1)
        points[by_azimuth.T.ravel()].tofile(tmp_path / "000000.bin")
        assert len(read_returns(tmp_path / "000000.bin")) == len(points)


@pytest.mark.data
def test_no_real_scan_is_taken_for_one_of_other_columns(data_dir: Path) -> None:
    files = [
        *(data_dir / "kitti/sequences/00/velodyne").glob("*.bin"),
        *(data_dir / "courtyard/velodyne").glob("*0.bin"),
    ]
    assert len(files) > 20
    assert all(len(read_returns(file)) for file in files)


@pytest.mark.parametrize("times", ["0 0.1 0.05 0.2", "0 0 0 0", "-1 -0.9 -0.8 -0.7"])
def test_times_that_do_not_ascend_are_rejected_with_their_line(tmp_path: Path, times: str) -> None:
    (tmp_path / "times.txt").write_text(times.replace(" ", "\n"))
    with pytest.raises(SegslamError, match=r"times\.txt:[123]: .* times must ascend and not be negative"):
        read_stamps(tmp_path / "times.txt")


def test_lines_of_times_are_counted_with_the_empty_ones(tmp_path: Path) -> None:
    file = tmp_path / "times.txt"
    for text, complaint in (
        ("0\n\n  \n0.1\nx\n", r"times\.txt:5: x is not a time"),
        ("\n\n0.1\r\n\n0.1\r\n", r"times\.txt:5: 0\.1 is not later than the previous line, 0\.1;"),
        ("0 0.1\n", r"times\.txt:1: 0 0\.1 is not a time"),
    ):
        file.write_text(text)
        with pytest.raises(SegslamError, match=complaint):
            read_stamps(file)
    file.write_text("\n0\n\n 0.1 \n")
    assert read_stamps(file).tolist() == [0, 100_000_000]


def test_frames_that_the_data_does_not_have_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    for frames, expected in (("-1:3", "write A:B"), ("3:1", "selects no scan"), ("9:12", "has no such scan")):
        with pytest.raises(SegslamError, match=expected):
            selected_rows(np.arange(4), frames, Path("drive"))
    assert len(selected_rows(np.arange(4), "0:100", Path("drive"))) == 4
    assert "the last scan of drive is 3" in caplog.text


@pytest.mark.parametrize(("asked_deg", "applied_deg"), [(None, 0.205), (0.0, 0.0), (0.3, 0.3)])
def test_scans_are_raised_by_the_given_angle_and_by_default_by_kitti_s(
    tmp_path: Path, asked_deg: float | None, applied_deg: float
) -> None:
    folder = _write_sequence(tmp_path, [0])
    stored = read_returns(folder / "velodyne" / "000000.bin")[:, :3]
    dataset = open_dataset(folder, labels="none", vertical_angle_deg=asked_deg)
    assert dataset.vertical_angle_deg == applied_deg
    np.testing.assert_array_equal(dataset[0].points, raise_beams(stored, applied_deg))


def test_points_that_are_no_returns_go_with_their_labels(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0])
    rows = np.array([[1, 2, 3, 0], [np.nan, 2, 3, 0], [0, 0, 0, 0], [4, 5, 6, 0], [np.inf, 0, 0, 0]], dtype=np.float32)
    rows.tofile(folder / "velodyne" / "000000.bin")
    (folder / "labels").mkdir()
    np.array([10, 11, 40, 50, 70], dtype="<u4").tofile(folder / "labels" / "000000.label")
    scan = _open(tmp_path, labels="auto")[0]
    np.testing.assert_allclose(scan.points, raise_beams(rows[[0, 3], :3].astype(float), 0.205), atol=1e-6)
    np.testing.assert_array_equal(scan.labels, [Label.CAR, Label.BUILDING])
    assert scan.points.dtype == np.float32


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"0123456789", r"000001\.bin: 10 bytes are not a multiple of 16"),
        (b"", r"000001\.bin: has no points"),
        (np.full(8, np.nan, np.float32).tobytes(), r"000001\.bin: none of its 2 points is finite"),
    ],
)
def test_one_bad_scan_is_named_and_the_others_read(
    tmp_path: Path, content: bytes, complaint: str, caplog: pytest.LogCaptureFixture
) -> None:
    folder = _write_sequence(tmp_path, [0, 1, 2])
    (folder / "velodyne" / "000001.bin").write_bytes(content)
    dataset = _open(tmp_path)
    with pytest.raises(BadScan, match=complaint):
        dataset[1]
    with caplog.at_level(logging.WARNING):
        assert [scan.index for scan in dataset] == [0, 2]
    assert "scan 1 skipped" in caplog.text


def test_scan_that_vanishes_is_a_bad_scan(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0, 1])
    dataset = _open(tmp_path)
    (folder / "velodyne" / "000000.bin").unlink()
    with pytest.raises(BadScan, match=r"000000\.bin: no such file"):
        dataset[0]


def test_labels_of_another_length_are_one_bad_scan(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0, 1])
    (folder / "labels").mkdir()
    for number in (0, 1):
        np.full(5, 10, dtype="<u4").tofile(folder / "labels" / f"{number:06d}.label")
    np.full(5, 40, dtype="<u4").tofile(folder / "labels" / "000000.label")
    dataset = _open(tmp_path, labels="auto")
    np.testing.assert_array_equal(dataset[0].labels, [Label.ROAD] * 5)
    with pytest.raises(BadScan, match=r"000001\.label: 5 labels for 6 points"):
        dataset[1]


@pytest.mark.parametrize(
    ("file", "complaint"),
    [
        ("calib.txt", r"calib\.txt: no such file; put KITTI's"),
        ("times.txt", r"times\.txt: no such file; expected one time"),
        ("velodyne/000000.bin", r"velodyne: contains no \.bin file"),
    ],
)
def test_what_is_missing_is_named_at_opening(tmp_path: Path, file: str, complaint: str) -> None:
    folder = _write_sequence(tmp_path, [0])
    (folder / file).unlink()
    with pytest.raises(SegslamError, match=complaint):
        _open(tmp_path)


def test_unknown_sequence_names_those_there_are(tmp_path: Path) -> None:
    _write_sequence(tmp_path, [0])
    with pytest.raises(SegslamError, match=r"07: no such sequence; .* has: 03"):
        _open(tmp_path, sequence="7")


def test_a_sequence_folder_that_is_not_the_sequence_asked_for_is_refused(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0])
    assert len(_open(folder)) == 1
    assert len(_open(folder, sequence="00")) == 1  # the default
    with pytest.raises(SegslamError, match=r"--sequence 7: .*03 is another one; omit the option"):
        _open(folder, sequence="7")
    named = folder.rename(tmp_path / "drive")  # which has no number that could contradict
    assert len(_open(named, sequence="7")) == 1


def test_too_few_times_are_refused_with_both_numbers(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0, 4])
    (folder / "times.txt").write_text("0.0\n0.1\n")
    with pytest.raises(SegslamError, match=r"times\.txt: 2 lines, but there is a scan 4"):
        _open(tmp_path)


def test_broken_time_is_named_with_its_line(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0, 1])
    (folder / "times.txt").write_text("0.0\nnan\n")
    with pytest.raises(SegslamError, match=r"times\.txt:2: nan is not a time"):
        _open(tmp_path)


def test_two_scans_of_one_number_are_refused(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0, 1])
    (folder / "velodyne" / "1.bin").write_bytes((folder / "velodyne" / "000001.bin").read_bytes())
    with pytest.raises(SegslamError, match=r"000001\.bin: has the same number as 1\.bin"):
        _open(tmp_path)


def test_misnamed_scan_is_refused_but_hidden_files_are_not_scans(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0])
    (folder / "velodyne" / "._000000.bin").write_bytes(b"")
    assert len(_open(tmp_path)) == 1
    (folder / "velodyne" / "first.bin").write_bytes(b"")
    with pytest.raises(SegslamError, match=r"first\.bin: the name is not a scan number"):
        _open(tmp_path)


@pytest.mark.parametrize("key", ["Tr:", "Tr_velo_to_cam:", "Tr_velo_cam"])
def test_calibration_is_known_by_each_of_its_names(tmp_path: Path, key: str) -> None:
    file = tmp_path / "calib.txt"
    file.write_text(f"P0: 1 2 3\n\n{key} {_line(T_CAMERA_LIDAR)}\n")
    np.testing.assert_allclose(read_calibration(file), T_CAMERA_LIDAR)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [("P0: 1 2\n", "no line begins"), ("Tr: 1 2 3\n", r"calib\.txt:1: expected 12"), ("Tr: " + "nan " * 12, "finite")],
)
def test_broken_calibration_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(SegslamError, match=complaint):
        read_calibration(tmp_path / "calib.txt")


@pytest.mark.data
def test_real_scan_and_truth_are_those_of_kiss_icps_reader(data_dir: Path) -> None:
    from kiss_icp.datasets.kitti import KITTIOdometryDataset

    oracle = KITTIOdometryDataset(data_dir / "kitti", "00")
    dataset = open_dataset(data_dir / "kitti", labels="none", frames="4413:")
    assert dataset.reference is not None
    np.testing.assert_allclose(dataset[0].points, oracle[17][0], atol=3e-5)  # float32 at 80 m
    # kiss_icp keeps the rounding of the calibration and of the poses, a few 1e-7 of 400 m
    np.testing.assert_allclose(dataset.reference.T_world_lidar[0], oracle.gt_poses[4413], atol=1e-3)


@pytest.mark.data
def test_real_labels_have_a_row_for_each_point(data_dir: Path) -> None:
    scan = open_dataset(data_dir / "kitti", frames="0:3")[2]
    assert len(scan.labels) == len(scan.points) == 124478
    # the road is where the car stands: nothing of it is above the sensor
    assert scan.points[scan.labels == Label.ROAD, 2].max() < 0.5


@pytest.mark.data
def test_real_file_reads_as_it_was_written(data_dir: Path) -> None:
    file = data_dir / "kitti" / "sequences" / "00" / "velodyne" / "000000.bin"
    np.testing.assert_array_equal(read_returns(file), np.fromfile(file, np.float32).reshape(-1, 4))


@pytest.mark.parametrize(
    "numbers",
    [
        "0 0 0 0 0 0 0 0 0 0 0 0",
        "-1 0 0 0 0 1 0 0 0 0 1 0",
        "718 0 607 0 0 718 185 0 0 0 1 0",
        "1 0 0 0 0 1 0.05 0 0 0 1 0",
    ],
)
def test_a_calibration_that_is_no_rotation_is_refused(tmp_path: Path, numbers: str) -> None:
    file = tmp_path / "calib.txt"
    file.write_text(f"Tr: {numbers}\n")
    with pytest.raises(SegslamError, match=r"calib\.txt:1: the 3x3 part is not a rotation"):
        read_calibration(file)


def test_a_scan_number_beyond_64_bits_is_refused(tmp_path: Path) -> None:
    folder = _write_sequence(tmp_path, [0, 1])
    (folder / "velodyne" / "99999999999999999999.bin").write_bytes(bytes(16))
    with pytest.raises(SegslamError, match=r"99999999999999999999\.bin: the name is not a scan number"):
        _open(tmp_path)
