"""Pose files in and out."""

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from helpers.drives import random_path

from segslam.core import pose_files
from segslam.core.types import SegslamError


def test_kitti_file_gives_back_its_poses(tmp_path: Path) -> None:
    poses = random_path(np.random.default_rng(0), 20)
    pose_files.write_kitti(tmp_path / "poses.txt", poses)
    read = pose_files.read_poses(tmp_path / "poses.txt")
    assert read.stamp_ns is None
    np.testing.assert_allclose(read.T_a_b, poses, atol=1e-10)  # 12 digits are written


def test_tum_file_gives_back_its_poses_and_every_nanosecond(tmp_path: Path) -> None:
    poses = random_path(np.random.default_rng(1), 4)
    stamps = np.array([-1, 0, 1_764_000_000_123_456_789, 1_764_000_000_123_456_790])
    pose_files.write_tum(tmp_path / "poses.txt", stamps, poses)
    read = pose_files.read_poses(tmp_path / "poses.txt")
    assert read.stamp_ns is not None
    np.testing.assert_array_equal(read.stamp_ns, stamps)
    np.testing.assert_allclose(read.T_a_b, poses, atol=1e-10)


def test_evo_reads_both_files_as_they_are(tmp_path: Path) -> None:
    poses = random_path(np.random.default_rng(2), 30)
    stamps = np.arange(30) * 100_000_000
    pose_files.write_kitti(tmp_path / "kitti.txt", poses)
    pose_files.write_tum(tmp_path / "tum.txt", stamps, poses)
    by_kitti = file_interface.read_kitti_poses_file(tmp_path / "kitti.txt")
    by_tum = file_interface.read_tum_trajectory_file(tmp_path / "tum.txt")
    np.testing.assert_allclose(by_kitti.poses_se3, poses, atol=1e-10)
    np.testing.assert_allclose(by_tum.poses_se3, poses, atol=1e-10)
    np.testing.assert_allclose(by_tum.timestamps, stamps * 1e-9, atol=1e-9)


def test_rounded_matrices_become_rotations(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "poses.txt", random_path(np.random.default_rng(3), 10)[:, :3].reshape(-1, 12), fmt="%.4f")
    rotations = pose_files.read_poses(tmp_path / "poses.txt").T_a_b[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (10, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


def test_comments_blank_lines_commas_and_a_byte_order_mark_are_read_over(tmp_path: Path) -> None:
    text = "\ufeff# seconds x y z qx qy qz qw\n\n0.5, 1 2 3  0 0 0 1\n1.5 4 5 6 0 0 0 2e0 # doubled\n"
    file = tmp_path / "poses.txt"
    file.write_text(text.replace("2e0", "1.001"), encoding="utf-8")
    read = pose_files.read_poses(file)
    np.testing.assert_array_equal(read.stamp_ns, [500_000_000, 1_500_000_000])
    np.testing.assert_allclose(read.T_a_b[:, :3, 3], [[1, 2, 3], [4, 5, 6]])


def test_with_semicolons_commas_are_decimal_ones(tmp_path: Path) -> None:
    text = "seconds;x;y;z;qx;qy;qz;qw\n1,5;1,25; 2;-3e0;0,0;0,0;0,0;1,0\n"
    (tmp_path / "a.csv").write_text(text)
    read = pose_files.read_poses(tmp_path / "a.csv")
    assert read.stamp_ns is not None
    assert (read.stamp_ns.tolist(), read.T_a_b[0, :3, 3].tolist()) == ([1_500_000_000], [1.25, 2.0, -3.0])


def test_a_line_of_column_names_is_read_over_in_csv_alone(tmp_path: Path) -> None:
    text = "timestamp,x,y,z,qx,qy,qz,qw\n1.5,1,2,3,0,0,0,1\n"
    (tmp_path / "a.CSV").write_text(text)
    assert pose_files.read_poses(tmp_path / "a.CSV").T_a_b[0, :3, 3].tolist() == [1.0, 2.0, 3.0]
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(SegslamError, match=r"a\.txt:1: "):
        pose_files.read_poses(tmp_path / "a.txt")


EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1]"
)


ECHOED = "%time,field.header.seq,field.child_frame_id," + ",".join(
    [f"field.pose.pose.position.{axis}" for axis in "xyz"]
    + [f"field.pose.pose.orientation.{axis}" for axis in "xyzw"]
    + [f"field.twist.twist.linear.{axis}" for axis in "xyz"]
)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("orb_slam3.txt", "1700000000123456789.000000 1 2 3 0.6 0 0 0.8"),
        ("helipr.txt", "1700000000123456789 1 2 3 0.6 0 0 0.8"),
        ("newer_college.csv", "#sec,nsec,x,y,z,qx,qy,qz,qw\n1700000000,123456789,1,2,3,0.6,0,0,0.8"),
        ("newer_college.csv", "sec, nsec, x, y, z, qx, qy, qz, qw\n1700000000,123456789,1,2,3,0.6,0,0,0.8"),
        ("mcd.csv", "num,t,x,y,z,qx,qy,qz,qw\n5,1700000000.123456789,1,2,3,0.6,0,0,0.8"),
        ("spires.csv", "# counter, sec, nsec, x, y, z, qx, qy, qz, qw\n5, 1700000000, 123456789, 1,2,3,0.6,0,0,0.8"),
        ("euroc.csv", f"# EuRoC\n{EUROC}\n1700000000123456789,1,2,3,0.8,0.6,0,0,9,9,9,9"),
        ("tum_vi.csv", "#timestamp [ns],tx,ty,tz,qw,qx,qy,qz\r\n1700000000123456789,1,2,3,0.8,0.6,0,0\r"),
        ("w_first.txt", "# timestamp(s) tx ty tz qw qx qy qz\n\n1700000000.123456789 1 2 3 0.8 0.6 0 0"),
        ("echoed.csv", f"{ECHOED}\n1700000000123456789,7,base_link,1,2,3,0.6,0,0,0.8,9,9,9"),
    ],
)
def test_trajectories_of_other_programs_are_read(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text + "\n")
    read = pose_files.read_poses(tmp_path / name)
    assert read.stamp_ns is not None
    assert read.stamp_ns.tolist() == [1_700_000_000_123_456_789]
    np.testing.assert_allclose(read.T_a_b[0, :3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(read.T_a_b[0, :3, 1], [0.0, 0.28, 0.96])


def test_a_time_that_is_named_in_nanoseconds_may_count_from_any_start(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t_ns,x,y,z,qx,qy,qz,qw\n1500000000,0,0,0,0,0,0,1\n")
    assert pose_files.read_poses(tmp_path / "a.csv").stamp_ns == [1_500_000_000]


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("0,0,1,2,3,0,0,0", r"a\.csv:3: found 8 columns, but the line of names has 9"),
        ("never,0,1,2,3,0,0,0,1", r"a\.csv:3: never 0 is not a time"),
    ],
)
def test_a_line_that_does_not_fit_the_names_is_named(tmp_path: Path, line: str, complaint: str) -> None:
    (tmp_path / "a.csv").write_text(f"#sec,nsec,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,0,1\n{line}\n")
    with pytest.raises(SegslamError, match=complaint):
        pose_files.read_poses(tmp_path / "a.csv", format="tum")


def test_a_comment_that_is_no_line_of_names_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# saved by lazy z x y z w\n1.5 1 2 3 0 0 0 1\n")
    assert pose_files.read_poses(tmp_path / "a.txt").T_a_b[0, :3, 3].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1", "poses.txt:2: found 11 numbers; KITTI"),
        ("1 0 0 0 0 1 0 0 0 0 1 x", "poses.txt:2: could not convert string to float: 'x'"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0", "poses.txt:2: 1 0 0 nan"),
        ("2 0 0 0 0 2 0 0 0 0 2 0", "poses.txt:2: the 3x3 part is not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "poses.txt:2: the 3x3 part is not a rotation"),
        ("0 1 2 3 0 0 0 1", "poses.txt:2: found 8 numbers; KITTI"),
    ],
)
def test_broken_kitti_line_is_named(tmp_path: Path, line: str, complaint: str) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{line}\n")
    with pytest.raises(SegslamError, match=complaint):
        pose_files.read_poses(file)


@pytest.mark.parametrize("line", ["0 1 2 3 0 0 0 0", "0 1 2 3 1 1 1 1"])
def test_quaternion_that_is_no_rotation_is_named(tmp_path: Path, line: str) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(f"0 1 2 3 0 0 0 1\n{line}\n")
    with pytest.raises(SegslamError, match=r"poses\.txt:2: the quaternion is not a rotation"):
        pose_files.read_poses(file)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [("", "contains no pose"), ("# nothing\n", "contains no pose"), ("1 2 3\n", "found 3 numbers")],
)
def test_file_without_poses_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(text)
    with pytest.raises(SegslamError, match=complaint):
        pose_files.read_poses(file)


def test_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("missing.txt", "binary.txt"):
        with pytest.raises(SegslamError, match=name):
            pose_files.read_poses(tmp_path / name)


def test_named_format_is_demanded(tmp_path: Path) -> None:
    pose_files.write_kitti(tmp_path / "poses.txt", np.eye(4)[None])
    with pytest.raises(SegslamError, match=r"poses\.txt:1: found 12 numbers; TUM"):
        pose_files.read_poses(tmp_path / "poses.txt", format="tum")


def test_stamp_beyond_any_clock_is_named_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text("0 1 2 3 0 0 0 1\n1e19 1 2 3 0 0 0 1\n")  # nanoseconds taken for seconds
    with pytest.raises(SegslamError, match=r"poses\.txt:2: 1e19 s are more than 292 years"):
        pose_files.read_poses(file)


@pytest.mark.data
def test_official_ground_truth_reads_with_its_length(data_dir: Path) -> None:
    assert len(pose_files.read_poses(data_dir / "kitti" / "poses" / "04.txt")) == 271
