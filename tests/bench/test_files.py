"""What is written reads back as the truth, and stays whole when stopped."""

import json

import numpy as np
import pytest

from segslam.bench.simulation.files import prepare_folder, uncorrected, write_drive
from segslam.bench.simulation.sensor import drive_sweeps
from segslam.bench.simulation.tracks import NOMINAL_CALIB, Drive, example_drive, in_lane, read_drive
from segslam.bench.simulation.world import World
from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig, WorldConfig
from segslam.core.pose_files import read_poses, write_kitti
from segslam.core.types import Label, SegslamError
from segslam.labels.encodings import RAW_OF_LABEL
from segslam.scans import open_dataset

CONFIG = SimulationConfig(sensor=SensorConfig(name="vlp16"))


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Four scans spread over the made-up loop, where their cars are."""
    whole = example_drive()
    rows = [0, 60, 150, 220]
    return Drive(whole.T_world_lidar[rows], whole.time_s[rows], whole.calib)


@pytest.fixture(scope="module")
def sweeps(drive):
    world = World(drive.T_world_lidar, drive.time_s, config=CONFIG.world, seed=0)
    return list(drive_sweeps(world, drive.T_world_lidar, drive.time_s, config=CONFIG.sensor, seed=0))


@pytest.fixture(scope="module")
def written(drive, tmp_path_factory):
    out = tmp_path_factory.mktemp("kitti")
    prepare_folder(out, "03", overwrite=False)
    assert list(write_drive(out, "03", drive, config=CONFIG, seed=0)) == [1, 2, 3, 4]
    return out


def test_the_kitti_reader_gives_back_points_labels_and_stamps(written, drive, sweeps):
    dataset = open_dataset(written, sequence="03")
    assert len(dataset) == len(sweeps)
    for scan, one, time_s in zip(dataset, sweeps, drive.time_s, strict=True):
        np.testing.assert_allclose(scan.points, one.points, atol=2e-5)  # float32 at 100 m
        standing = np.where(one.labels == Label.MOVING_CAR, scan.labels, one.labels)
        np.testing.assert_array_equal(scan.labels, standing)
        assert scan.stamp_ns == round(time_s * 1e9)


def test_the_kitti_reader_gives_back_the_true_poses(written, drive):
    reference = open_dataset(written, sequence="03").reference
    T_first_lidar = np.linalg.inv(drive.T_world_lidar[0]) @ drive.T_world_lidar
    np.testing.assert_allclose(reference.T_world_lidar, T_first_lidar, atol=1e-6)  # ten digits in the file


def test_poses_are_the_cameras_from_its_first(written):
    poses = read_poses(written / "poses" / "03.txt", format="kitti").T_a_b
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)
    # the loop starts along x, which the camera calls z
    assert poses[1, 2, 3] > 10.0


def test_labels_are_raw_ids_with_instances_above(written, sweeps):
    raw = np.fromfile(written / "sequences" / "03" / "labels" / "000001.label", dtype="<u4")
    np.testing.assert_array_equal(raw >> 16, sweeps[1].instances)
    np.testing.assert_array_equal(raw & 0xFFFF, RAW_OF_LABEL[sweeps[1].labels])
    assert RAW_OF_LABEL[Label.CAR] == 10
    assert RAW_OF_LABEL[Label.MOVING_CAR] == 252


def test_points_are_lowered_by_what_readers_add():
    """On the horizon, straight up to the side, and below: 0.205 degrees each, range and azimuth kept."""
    points = np.array([[10.0, 0.0, 0.0], [0.0, 5.0, 2.0], [-3.0, -4.0, -1.5]])
    low = uncorrected(points)
    np.testing.assert_allclose(np.linalg.norm(low, axis=1), np.linalg.norm(points, axis=1))
    elevation = [np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))) for p in (points, low)]
    np.testing.assert_allclose(elevation[0] - elevation[1], 0.205, atol=1e-9)
    np.testing.assert_allclose(np.arctan2(low[:, 1], low[:, 0]), np.arctan2(points[:, 1], points[:, 0]))


def test_stopped_in_the_middle_it_is_a_shorter_sequence(drive, sweeps, tmp_path, monkeypatch):
    def stopped(*_, **__):
        yield from sweeps[:2]
        raise KeyboardInterrupt

    monkeypatch.setattr("segslam.bench.simulation.files.drive_sweeps", stopped)
    prepare_folder(tmp_path, "00", overwrite=False)
    with pytest.raises(KeyboardInterrupt):
        list(write_drive(tmp_path, "00", drive, config=CONFIG, seed=0))
    dataset = open_dataset(tmp_path, sequence="00")
    assert [scan.index for scan in dataset] == [0, 1]
    assert len(dataset.reference) == 2


@pytest.mark.long
def test_fewer_scans_are_the_same_scans(tmp_path):
    drive = example_drive()
    for name, count in (("a", 1), ("b", 2)):
        prepare_folder(tmp_path / name, "00", overwrite=False)
        list(write_drive(tmp_path / name, "00", drive, config=CONFIG, seed=4, num_frames=count))
    first = [(tmp_path / name / "sequences/00/velodyne/000000.bin").read_bytes() for name in ("a", "b")]
    assert first[0] == first[1]
    assert not (tmp_path / "a/sequences/00/velodyne/000001.bin").exists()
    kept = json.loads((tmp_path / "a/sequences/00/simulation.json").read_text())
    assert kept["seed"] == 4
    assert SimulationConfig.model_validate(kept["config"]) == CONFIG


def test_a_sequence_that_is_there_is_replaced_only_on_demand(drive, tmp_path):
    prepare_folder(tmp_path, "00", overwrite=False)
    list(write_drive(tmp_path, "00", drive, config=CONFIG, seed=0))
    with pytest.raises(SegslamError, match="--overwrite"):
        prepare_folder(tmp_path, "00", overwrite=False)
    prepare_folder(tmp_path, "00", overwrite=True)
    assert not list((tmp_path / "sequences/00/velodyne").iterdir())
    prepare_folder(tmp_path, "01", overwrite=False)  # beside it there is room


def test_real_data_is_never_replaced(tmp_path):
    scan = tmp_path / "sequences/00/velodyne/000000.bin"
    scan.parent.mkdir(parents=True)
    scan.write_bytes(b"real")
    with pytest.raises(SegslamError, match="was not simulated by segslam"):
        prepare_folder(tmp_path, "00", overwrite=True)
    assert scan.read_bytes() == b"real"


@pytest.mark.parametrize("name", ["../00", "a/b", "", ".."])
def test_a_sequence_needs_a_plain_name(tmp_path, name):
    with pytest.raises(SegslamError, match="plain name"):
        prepare_folder(tmp_path, name, overwrite=False)


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SegslamError, match="file"):
        prepare_folder(tmp_path / "file", "00", overwrite=False)


def kitti_poses(folder, *, count: int = 5):
    """A pose file five metres long in KITTI's folders, nothing beside it."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    (folder / "poses").mkdir()
    (folder / "sequences" / "07").mkdir(parents=True)
    write_kitti(folder / "poses" / "07.txt", poses)
    return folder / "poses" / "07.txt"


def test_without_calib_and_times_the_nominal_ones_serve(tmp_path):
    drive = read_drive(kitti_poses(tmp_path), sequence="00")
    assert drive.calib == NOMINAL_CALIB
    np.testing.assert_allclose(drive.time_s, 0.1 * np.arange(5))
    np.testing.assert_allclose(drive.T_world_lidar[:, 0, 3], np.arange(5), atol=1e-9)  # the camera's z is ahead


def test_calib_and_times_are_found_where_kitti_keeps_them(tmp_path):
    poses = kitti_poses(tmp_path)
    (tmp_path / "sequences/07/times.txt").write_text("0\n0.2\n0.3\n0.4\n0.9\n")
    turned = "Tr: 1 0 0 0 0 0 -1 0 0 1 0 0\n"
    (tmp_path / "sequences/07/calib.txt").write_text(turned)
    drive = read_drive(poses, sequence="00")
    assert drive.calib == turned
    assert drive.time_s[-1] == 0.9
    np.testing.assert_allclose(drive.T_world_lidar[:, 1, 3], np.arange(5), atol=1e-9)  # here the LiDAR's y is ahead


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("calib.txt", "P0: 1 2 3\n", "Tr"),
        ("calib.txt", "Tr: 1 2 three\n", "expected 12 numbers"),
        ("times.txt", "0\n0.1\n", "5 ascending times"),
        ("times.txt", "0\n0.1\n0.1\n0.2\n0.3\n", "times must ascend"),
        ("times.txt", "never\n", "never is not a time in seconds"),
    ],
)
def test_a_broken_file_beside_the_poses_is_named(tmp_path, name, text, complaint):
    poses = kitti_poses(tmp_path)
    (tmp_path / "sequences/07" / name).write_text(text)
    with pytest.raises(SegslamError, match=complaint) as caught:
        read_drive(poses, sequence="00")
    assert name in str(caught.value)


def test_a_standing_car_is_a_drive_too(tmp_path):
    poses = np.tile(np.eye(4), (2, 1, 1))
    drive = Drive(poses, np.array([0.0, 0.1]), NOMINAL_CALIB)
    config = SimulationConfig(world=WorldConfig(), sensor=SensorConfig(name="vlp16"))
    prepare_folder(tmp_path, "00", overwrite=False)
    assert list(write_drive(tmp_path, "00", drive, config=config, seed=0)) == [1, 2]


def test_two_drives_through_one_town_have_poses_in_one_frame(tmp_path):
    drive = example_drive(3)
    back = in_lane(drive, left_m=2.0, reverse=True)
    prepare_folder(tmp_path, "04", overwrite=False)
    list(write_drive(tmp_path, "04", drive, config=CONFIG, seed=0, driven=back, num_frames=2))
    reference = open_dataset(tmp_path, sequence="04").reference
    T_first_lidar = np.linalg.inv(drive.T_world_lidar[0]) @ drive.T_world_lidar
    last = T_first_lidar[-1]
    np.testing.assert_allclose(reference.T_world_lidar[0, :3, 0], -last[:3, 0], atol=1e-6)  # it looks back
    aside = np.linalg.inv(last) @ reference.T_world_lidar[0]
    np.testing.assert_allclose(aside[:3, 3], [0.0, -2.0, 0.0], atol=1e-6)  # the left of a car that drives back
    assert (np.diff(back.time_s) > 0).all()
