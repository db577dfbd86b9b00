"""Trajectories between KITTI, TUM and CSV, read back by evo."""

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from helpers.commands import run
from helpers.drives import round_drive

from segslam.core import geometry
from segslam.core.errors import SegslamError
from segslam.core.pose_files import read_poses, write_kitti, write_tum
from segslam.core.trajectory import camera_from_lidar
from segslam.output.conversion import HEADER, convert

T_CAMERA_LIDAR = geometry.transform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.0, -0.08, -0.27]))
CALIB = "Tr: " + " ".join(f"{value:.9g}" for value in T_CAMERA_LIDAR[:3].ravel()) + "\n"
TRUTH = round_drive()[1]


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    write_tum(tmp_path / "in.tum", TRUTH.stamp_ns, TRUTH.T_world_lidar)
    return tmp_path / "in.tum"


def test_tum_to_csv_and_back_keeps_stamps_and_poses(tum: Path, tmp_path: Path) -> None:
    assert convert(tum, tmp_path / "a.csv") == len(TRUTH)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == HEADER
    assert len(lines) == len(TRUTH) + 1
    assert lines[1].count(",") == 7
    convert(tmp_path / "a.csv", tmp_path / "back.txt")
    back = read_poses(tmp_path / "back.txt", format="tum")
    np.testing.assert_array_equal(back.stamp_ns, TRUTH.stamp_ns)
    np.testing.assert_allclose(back.T_a_b, TRUTH.T_world_lidar, atol=1e-9)


def test_kitti_needs_times_for_stamps(tum: Path, tmp_path: Path) -> None:
    convert(tum, tmp_path / "a.kitti")
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "a.kitti"))
    np.testing.assert_allclose(np.array(kitti.poses_se3), TRUTH.T_world_lidar, atol=1e-9)
    with pytest.raises(SegslamError, match=r"has no stamps.*--times"):
        convert(tmp_path / "a.kitti", tmp_path / "b.tum")
    times = tmp_path / "times.txt"
    times.write_text("".join(f"{stamp / 1e9:.9f}\n" for stamp in TRUTH.stamp_ns))
    convert(tmp_path / "a.kitti", tmp_path / "b.tum", times=times)
    made = file_interface.read_tum_trajectory_file(str(tmp_path / "b.tum"))
    np.testing.assert_allclose(made.poses_se3, TRUTH.T_world_lidar, atol=1e-8)
    np.testing.assert_allclose(made.timestamps, TRUTH.stamp_ns / 1e9, atol=1e-9)
    with pytest.raises(SegslamError, match="stamps of its own"):
        convert(tmp_path / "b.tum", tmp_path / "c.tum", times=times)
    times.write_text("0\n1\n")
    with pytest.raises(SegslamError, match="2 times"):
        convert(tmp_path / "a.kitti", tmp_path / "b.tum", times=times)


def test_camera_and_lidar_frames_are_those_of_kitti(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(CALIB)
    poses = geometry.inverse(TRUTH.T_world_lidar[0]) @ TRUTH.T_world_lidar
    cameras = camera_from_lidar(poses, T_CAMERA_LIDAR)
    write_kitti(tmp_path / "camera.txt", cameras)
    convert(tmp_path / "camera.txt", tmp_path / "lidar.txt", calib=tmp_path / "calib.txt", to="lidar")
    np.testing.assert_allclose(read_poses(tmp_path / "lidar.txt").T_a_b, poses, atol=1e-6)
    convert(tmp_path / "lidar.txt", tmp_path / "again.txt", calib=tmp_path / "calib.txt", to="camera")
    np.testing.assert_allclose(read_poses(tmp_path / "again.txt").T_a_b, cameras, atol=1e-6)
    with pytest.raises(SegslamError, match="belong together"):
        convert(tmp_path / "lidar.txt", tmp_path / "no.txt", to="camera")
    assert not (tmp_path / "no.txt").exists()


def test_a_quaternion_that_begins_with_w_is_read_by_the_names_of_its_columns(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("timestamp,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,1,0,0,0.8,0.6,0,0\n")
    assert run("convert", tmp_path / "a.csv", tmp_path / "a.tum") == 0
    assert (tmp_path / "a.tum").read_text().splitlines()[1] == "1.000000000 1 0 0 0.6 0 0 0.8"


@pytest.mark.parametrize("names", ["x,y,z,seconds,qx,qy,qz,qw", "seconds,y,x,z,qx,qy,qz,qw"])
def test_any_other_order_of_the_columns_is_refused(tmp_path: Path, names: str) -> None:
    (tmp_path / "a.csv").write_text(f"{names}\n0,0,0,0,0,0,0,1\n1,1,0,0,0,0,0,1\n")
    with pytest.raises(SegslamError, match=r"a\.csv:1: its columns are .*; reorder them: TUM"):
        read_poses(tmp_path / "a.csv")


@pytest.mark.parametrize(
    "names", ["seconds,x,y,z,qx,qy,qz,qw", "seconds,x,y,z,qx,qy,qz,qw,", "Time,Pos_X,Pos_Y,Pos_Z,q1,q2,q3,q4"]
)
def test_other_names_of_the_same_columns_are_read(tmp_path: Path, names: str) -> None:
    (tmp_path / "a.csv").write_text(f"{names}\n0,0,0,0,0,0,0,1\n1,1,0,0,0,0,0,1\n")
    assert len(read_poses(tmp_path / "a.csv")) == 2


def test_the_command_converts_and_does_not_replace(
    tum: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("convert", tum, tmp_path / "out.csv") == 0
    assert f"{len(TRUTH)} poses in {tmp_path / 'out.csv'}" in capsys.readouterr().err
    assert run("convert", tum, tmp_path / "out.csv") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert run("convert", tum, tmp_path / "out.csv", "--overwrite", "--to", "kitti", "-q") == 0
    assert len(read_poses(tmp_path / "out.csv", format="kitti")) == len(TRUTH)
    assert run("convert", tmp_path / "out.csv", tmp_path / "no.csv", "--from", "tum") == 2
    assert "out.csv:1: found 12 numbers" in capsys.readouterr().err
