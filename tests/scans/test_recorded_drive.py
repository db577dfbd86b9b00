"""Recordings made by others' writers, from the file to the map."""

import re
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from helpers.commands import run
from helpers.other_recordings import (
    write_humble,
    write_livox_bag1,
    write_livox_bag2,
    write_livox_mcap,
    write_mcap_of_ros1,
)
from helpers.recorded_drive import (
    CLOUD,
    FIRST_STAMP_NS,
    OTHER_TOPIC,
    SWEEP_NS,
    TOPIC,
    Drive,
    clouds,
    truth,
    write_bag1,
    write_bag2,
    write_mcap,
)

from segslam.core.evaluation import trajectory_metrics
from segslam.core.pose_files import read_poses
from segslam.core.types import BadScan, SegslamError
from segslam.gnss.reading import read_fixes
from segslam.scans import open_dataset

pytestmark = pytest.mark.usefixtures("short_runs")


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (write_mcap, "drive.mcap"),
        (write_bag1, "drive.bag"),
        (write_bag2, "drive"),
        (write_humble, "drive"),
        (write_mcap_of_ros1, "drive.mcap"),
    ],
)
def test_a_recording_gives_its_points_with_times_in_step_and_its_stamps(
    tmp_path: Path, write: Callable[[Path], Path], name: str
) -> None:
    dataset = open_dataset(write(tmp_path / name), topic=TOPIC)
    assert len(dataset) == len(clouds())
    for row in (0, 1, 7):
        scan, (stamp_ns, rows) = dataset[row], clouds()[row]
        returned = rows[np.isfinite(rows["x"])]
        assert scan.stamp_ns == stamp_ns, "the header's, not when it was received"
        np.testing.assert_array_equal(scan.points, np.column_stack([returned[axis] for axis in "xyz"]))
        np.testing.assert_allclose(scan.times, returned["t"] / SWEEP_NS, atol=1e-12)


@pytest.mark.parametrize(
    ("write", "name"),
    [(write_livox_mcap, "drive.mcap"), (write_livox_bag1, "drive.bag"), (write_livox_bag2, "drive")],
)
def test_the_messages_of_livox_are_read_as_clouds(
    tmp_path: Path, write: Callable[[Path, Drive], Path], name: str
) -> None:
    drive = tuple((stamp_ns, rows[1:500]) for stamp_ns, rows in clouds()[:2])
    dataset = open_dataset(write(tmp_path / name, drive), intensities=True)
    assert len(dataset) == 2
    for scan, (stamp_ns, rows) in zip(dataset, drive, strict=True):
        returned = rows[np.isfinite(rows["x"])]
        assert (scan.stamp_ns, scan.stamp_time) == (stamp_ns, 0.0)
        np.testing.assert_array_equal(scan.points, np.column_stack([returned[axis] for axis in "xyz"]))
        np.testing.assert_array_equal(scan.intensities, np.floor(returned["intensity"]))
        np.testing.assert_allclose(scan.times, returned["t"] / SWEEP_NS, atol=1e-12)


def test_a_message_of_livox_that_is_cut_short_is_a_bad_scan(tmp_path: Path) -> None:
    drive = tuple((stamp_ns, rows[1:50]) for stamp_ns, rows in clouds()[:3])
    recording = write_livox_bag2(tmp_path / "drive", drive)
    with sqlite3.connect(next(recording.glob("*.db3"))) as database:
        whole = database.execute("SELECT data FROM messages WHERE id = 2").fetchone()[0]
        for length, complaint in ((len(whole) - 2, "49 points"), (30, "unpack_from requires")):
            database.execute("UPDATE messages SET data = ? WHERE id = 2", (whole[:length],))
            database.commit()
            dataset = open_dataset(recording)
            with pytest.raises(BadScan, match=complaint):
                dataset[1]
            assert len(list(dataset)) == 2
    database.close()


def test_a_bag_whose_metadata_another_program_has_changed_is_read(tmp_path: Path) -> None:
    """The quality of service is then not that in the file, as after a conversion of Jazzy's metadata for Humble."""
    folder = write_bag2(tmp_path / "drive", tuple((10**9 * row, np.ones(5, CLOUD)) for row in (1, 2, 3)))
    unlimited = "{sec: 2147483647, nsec: 4294967295}"
    quality = ", ".join(
        [
            *("history: 3", "depth: 0", "reliability: 1", "durability: 2", "liveliness: 1"),
            *(f"{name}: {unlimited}" for name in ("deadline", "lifespan", "liveliness_lease_duration")),
            "avoid_ros_namespace_conventions: false",
        ]
    )
    metadata = (folder / "metadata.yaml").read_text()
    changed = metadata.replace("offered_qos_profiles: ''", f"offered_qos_profiles: '[{{{quality}}}]'")
    assert changed != metadata
    (folder / "metadata.yaml").write_text(re.sub(r"RIHS01_\w+", f"RIHS01_{64 * '0'}", changed))
    assert len(list(open_dataset(folder))) == 3


@pytest.mark.parametrize("has_stamps", [True, False])
def test_the_stamp_of_a_header_is_at_the_start_of_the_sweep_that_of_a_log_is_not(
    tmp_path: Path, has_stamps: bool
) -> None:
    dataset = open_dataset(write_mcap(tmp_path / "drive.mcap", has_stamps=has_stamps), topic=TOPIC)
    assert [dataset[row].stamp_ns for row in (0, 3)] == [clouds()[row][0] for row in (0, 3)]
    assert dataset[3].stamp_time == (0.0 if has_stamps else 1.0)


def _ate_m(folder: Path) -> float:
    """Error without the first scans: the recording starts at full speed, and the first sweeps cannot be deskewed."""
    poses = read_poses(folder / "odometry_tum.txt")
    return trajectory_metrics(poses.T_a_b[8:], truth().T_world_lidar[8:])["ate_m"]


@pytest.mark.slow
def test_times_of_points_make_the_map_of_a_recording_better(tmp_path: Path) -> None:
    recording = write_mcap(tmp_path / "drive.mcap")
    errors_m = {}
    for deskew in (True, False):
        out = tmp_path / f"deskew-{deskew}"
        command = ("map", recording, "--topic", TOPIC, "--out", out, "--quiet")
        assert run(*command, "--set", f"odometry.deskew={deskew}") == 0
        errors_m[deskew] = _ate_m(out)
    assert errors_m[True] < 0.8 * errors_m[False], "the first sweeps, which cannot be corrected, are in both"
    stamps_ns = read_poses(out / "odometry_tum.txt").stamp_ns
    np.testing.assert_allclose(stamps_ns, FIRST_STAMP_NS + SWEEP_NS * np.arange(len(clouds())), rtol=0, atol=1_000)


def test_a_dry_run_shows_how_the_times_of_points_are_understood(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The stamp of a recorded cloud is at the start of its sweep; that of a file alone is not known to be."""
    recording, files = write_mcap(tmp_path / "drive.mcap"), tmp_path / "files"
    files.mkdir()
    scan = open_dataset(recording, topic=TOPIC)[0]
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(scan.points))
    cloud.point["t"] = o3d.core.Tensor((scan.times * SWEEP_NS).astype(np.float64)[:, None])
    o3d.t.io.write_point_cloud(str(files / "0.pcd"), cloud)
    for data, expected in ((recording, "poses at 0.000 s of it"), (files, "poses at 0.100 s of it")):
        topic = ("--topic", TOPIC) if data == recording else ()
        assert run("map", data, *topic, "--dry-run") == 0
        assert f"point times: a sweep of 0.100 s, {expected}" in capsys.readouterr().out


def test_a_recording_with_several_topics_needs_the_option_topic(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = write_mcap(tmp_path / "drive.mcap")
    for options in ((), ("--topic", "/camera")):
        assert run("map", recording, *options, "--out", tmp_path / "run") == 2
        complaint = capsys.readouterr().err
        assert f"--topic {OTHER_TOPIC}, --topic {TOPIC}" in complaint
        assert "reindex" not in complaint
        assert "recover" not in complaint


def test_a_recording_without_an_index_is_reported_with_the_remedy(tmp_path: Path) -> None:
    recording = write_mcap(tmp_path / "drive.mcap")
    recording.write_bytes(recording.read_bytes()[:-100])
    with pytest.raises(SegslamError, match=r"drive\.mcap: .*no index.*mcap recover"):
        open_dataset(recording, topic=TOPIC)


@pytest.mark.parametrize("content", [b"", b"a text\n"])
def test_another_file_with_the_name_of_a_recording_is_not_taken_for_a_damaged_one(
    content: bytes, tmp_path: Path
) -> None:
    (tmp_path / "drive.mcap").write_bytes(content)
    for read in (open_dataset, read_fixes):
        with pytest.raises(
            SegslamError, match=r"drive\.mcap: cannot be opened as MCAP, it is empty or of another kind; copy it again"
        ):
            read(tmp_path / "drive.mcap")


@pytest.mark.slow
def test_folders_of_clouds_are_mapped_as_the_recording_of_them(tmp_path: Path) -> None:
    (tmp_path / "ply").mkdir()
    (tmp_path / "pcd").mkdir()
    for number, (_, rows) in enumerate(clouds()[:5]):
        rows = rows[np.isfinite(rows["x"])]
        cloud = o3d.t.geometry.PointCloud(np.column_stack([rows[axis] for axis in "xyz"]))
        cloud.point["t"] = o3d.core.Tensor(rows["t"].astype(np.float32)[:, None])
        for suffix in ("ply", "pcd"):
            o3d.t.io.write_point_cloud(str(tmp_path / suffix / f"{number}.{suffix}"), cloud)
    recording = write_mcap(tmp_path / "drive.mcap")
    poses = []
    for data, options in ((recording, ("--topic", TOPIC)), (tmp_path / "ply", ()), (tmp_path / "pcd", ())):
        out = tmp_path / f"run-{data.name}"
        words = ("map", data, "--out", out, "--frames", "0:5", "--quiet", *options)
        assert run(*words, "--set", "adjustment.max_minutes=0") == 0
        poses.append(read_poses(out / "odometry_tum.txt").T_a_b)
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-4)  # times in float32
    np.testing.assert_allclose(poses[2], poses[0], atol=1e-4)
