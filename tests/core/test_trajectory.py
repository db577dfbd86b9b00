"""Pose files in and out, rows that belong together, and the correction of all scans."""

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st

from segslam.core import geometry, trajectory
from segslam.core.types import SegslamError


def _drive(rng: np.random.Generator, num_poses: int) -> np.ndarray:
    """A path of small random steps, as odometry gives it."""
    T_odom_lidar = [np.eye(4)]
    for _ in range(num_poses - 1):
        step = geometry.tangent(rotation_rad=0.1 * rng.normal(size=3), translation_m=[1.0, 0.1, 0.0])
        T_odom_lidar.append(T_odom_lidar[-1] @ geometry.exp(step))
    return np.array(T_odom_lidar)


def test_kitti_file_gives_back_its_poses(tmp_path: Path) -> None:
    poses = _drive(np.random.default_rng(0), 20)
    trajectory.write_kitti(tmp_path / "poses.txt", poses)
    read = trajectory.read_poses(tmp_path / "poses.txt")
    assert read.stamp_ns is None
    np.testing.assert_allclose(read.T_a_b, poses, atol=1e-10)  # 12 digits are written


def test_tum_file_gives_back_its_poses_and_every_nanosecond(tmp_path: Path) -> None:
    poses = _drive(np.random.default_rng(1), 4)
    stamps = np.array([-1, 0, 1_764_000_000_123_456_789, 1_764_000_000_123_456_790])
    trajectory.write_tum(tmp_path / "poses.txt", stamps, poses)
    read = trajectory.read_poses(tmp_path / "poses.txt")
    assert read.stamp_ns is not None
    np.testing.assert_array_equal(read.stamp_ns, stamps)
    np.testing.assert_allclose(read.T_a_b, poses, atol=1e-10)


def test_evo_reads_both_files_as_they_are(tmp_path: Path) -> None:
    poses = _drive(np.random.default_rng(2), 30)
    stamps = np.arange(30) * 100_000_000
    trajectory.write_kitti(tmp_path / "kitti.txt", poses)
    trajectory.write_tum(tmp_path / "tum.txt", stamps, poses)
    by_kitti = file_interface.read_kitti_poses_file(tmp_path / "kitti.txt")
    by_tum = file_interface.read_tum_trajectory_file(tmp_path / "tum.txt")
    np.testing.assert_allclose(by_kitti.poses_se3, poses, atol=1e-10)
    np.testing.assert_allclose(by_tum.poses_se3, poses, atol=1e-10)
    np.testing.assert_allclose(by_tum.timestamps, stamps * 1e-9, atol=1e-9)


def test_rounded_matrices_become_rotations(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "poses.txt", _drive(np.random.default_rng(3), 10)[:, :3].reshape(-1, 12), fmt="%.4f")
    rotations = trajectory.read_poses(tmp_path / "poses.txt").T_a_b[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (10, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


def test_comments_blank_lines_commas_and_a_byte_order_mark_are_read_over(tmp_path: Path) -> None:
    text = "\ufeff# seconds x y z qx qy qz qw\n\n0.5, 1 2 3  0 0 0 1\n1.5 4 5 6 0 0 0 2e0 # doubled\n"
    file = tmp_path / "poses.txt"
    file.write_text(text.replace("2e0", "1.001"), encoding="utf-8")
    read = trajectory.read_poses(file)
    np.testing.assert_array_equal(read.stamp_ns, [500_000_000, 1_500_000_000])
    np.testing.assert_allclose(read.T_a_b[:, :3, 3], [[1, 2, 3], [4, 5, 6]])


def test_with_semicolons_commas_are_decimal_ones(tmp_path: Path) -> None:
    text = "seconds;x;y;z;qx;qy;qz;qw\n1,5;1,25; 2;-3e0;0,0;0,0;0,0;1,0\n"
    (tmp_path / "a.csv").write_text(text)
    read = trajectory.read_poses(tmp_path / "a.csv")
    assert read.stamp_ns is not None
    assert (read.stamp_ns.tolist(), read.T_a_b[0, :3, 3].tolist()) == ([1_500_000_000], [1.25, 2.0, -3.0])


def test_a_line_of_column_names_is_read_over_in_csv_alone(tmp_path: Path) -> None:
    text = "timestamp,x,y,z,qx,qy,qz,qw\n1.5,1,2,3,0,0,0,1\n"
    (tmp_path / "a.CSV").write_text(text)
    assert trajectory.read_poses(tmp_path / "a.CSV").T_a_b[0, :3, 3].tolist() == [1.0, 2.0, 3.0]
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(SegslamError, match=r"a\.txt:1: "):
        trajectory.read_poses(tmp_path / "a.txt")


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
        ("euroc.csv", f"# EuRoC\n{EUROC}\n1700000000123456789,1,2,3,0.8,0.6,0,0,9,9,9,9"),
        ("tum_vi.csv", "#timestamp [ns],tx,ty,tz,qw,qx,qy,qz\r\n1700000000123456789,1,2,3,0.8,0.6,0,0\r"),
        ("w_first.txt", "# timestamp(s) tx ty tz qw qx qy qz\n\n1700000000.123456789 1 2 3 0.8 0.6 0 0"),
        ("echoed.csv", f"{ECHOED}\n1700000000123456789,7,base_link,1,2,3,0.6,0,0,0.8,9,9,9"),
    ],
)
def test_trajectories_of_other_programs_are_read(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text + "\n")
    read = trajectory.read_poses(tmp_path / name)
    assert read.stamp_ns is not None
    assert read.stamp_ns.tolist() == [1_700_000_000_123_456_789]
    np.testing.assert_allclose(read.T_a_b[0, :3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(read.T_a_b[0, :3, 1], [0.0, 0.28, 0.96])


def test_a_time_that_is_named_in_nanoseconds_may_count_from_any_start(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t_ns,x,y,z,qx,qy,qz,qw\n1500000000,0,0,0,0,0,0,1\n")
    assert trajectory.read_poses(tmp_path / "a.csv").stamp_ns == [1_500_000_000]


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
        trajectory.read_poses(tmp_path / "a.csv", format="tum")


def test_a_comment_that_is_no_line_of_names_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# saved by lazy z x y z w\n1.5 1 2 3 0 0 0 1\n")
    assert trajectory.read_poses(tmp_path / "a.txt").T_a_b[0, :3, 3].tolist() == [1.0, 2.0, 3.0]


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
        trajectory.read_poses(file)


@pytest.mark.parametrize("line", ["0 1 2 3 0 0 0 0", "0 1 2 3 1 1 1 1"])
def test_quaternion_that_is_no_rotation_is_named(tmp_path: Path, line: str) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(f"0 1 2 3 0 0 0 1\n{line}\n")
    with pytest.raises(SegslamError, match=r"poses\.txt:2: the quaternion is not a rotation"):
        trajectory.read_poses(file)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [("", "contains no pose"), ("# nothing\n", "contains no pose"), ("1 2 3\n", "found 3 numbers")],
)
def test_file_without_poses_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(text)
    with pytest.raises(SegslamError, match=complaint):
        trajectory.read_poses(file)


def test_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("missing.txt", "binary.txt"):
        with pytest.raises(SegslamError, match=name):
            trajectory.read_poses(tmp_path / name)


def test_named_format_is_demanded(tmp_path: Path) -> None:
    trajectory.write_kitti(tmp_path / "poses.txt", np.eye(4)[None])
    with pytest.raises(SegslamError, match=r"poses\.txt:1: found 12 numbers; TUM"):
        trajectory.read_poses(tmp_path / "poses.txt", format="tum")


def test_camera_and_lidar_frames_undo_each_other_and_start_at_the_origin() -> None:
    poses = _drive(np.random.default_rng(4), 5)
    T_camera_lidar = geometry.exp(geometry.tangent(rotation_rad=[1.2, -1.2, 1.2], translation_m=[0.0, -0.1, -0.3]))
    cameras = trajectory.camera_from_lidar(poses, T_camera_lidar)
    np.testing.assert_allclose(cameras[0], np.eye(4), atol=1e-15)
    np.testing.assert_allclose(trajectory.lidar_from_camera(cameras, T_camera_lidar), poses, atol=1e-13)


def test_stamps_pair_with_their_mutual_nearest_within_the_bound() -> None:
    a = np.array([0, 100, 200, 300])
    b = np.array([310, 104, 96, 1000])
    pairs = trajectory.rows_of_same_stamp(a, b, max_difference_ns=10)
    np.testing.assert_array_equal(pairs, [[1, 2], [3, 0]])  # 96 and 104 are as near: the earlier one


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(0, 200), min_size=1, max_size=15, unique=True),
    st.lists(st.integers(0, 200), min_size=1, max_size=15, unique=True),
)
def test_pairs_by_stamp_are_those_of_a_search_through_all(a: list[int], b: list[int]) -> None:
    pairs = trajectory.rows_of_same_stamp(np.array(a), np.array(b), max_difference_ns=20)
    for row_a, row_b in pairs:
        gap = abs(a[row_a] - b[row_b])
        assert gap == min(abs(a[row_a] - other) for other in b)
        assert gap == min(abs(other - b[row_b]) for other in a)
        assert gap <= 20
    if min(abs(x - y) for x in a for y in b) <= 20:
        assert len(pairs) > 0
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)


def test_no_stamps_pair_with_nothing() -> None:
    empty = np.empty(0, dtype=np.int64)
    assert trajectory.rows_of_same_stamp(empty, np.array([1]), max_difference_ns=5).shape == (0, 2)


def test_scans_pair_by_number_whatever_the_order() -> None:
    pairs = trajectory.rows_of_same_scan(np.array([7, 3, 9]), np.array([3, 4, 7]))
    np.testing.assert_array_equal(pairs, [[1, 0], [0, 2]])


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("0", 0),
        ("1.5", 1_500_000_000),
        ("4.574208e+02", 457_420_800_000),
        ("1764000000.123456789", 1764000000123456789),
        ("1764000000123", 1764000000123000000),
        ("1764000000123456", 1764000000123456000),
        ("1764000000123456789", 1764000000123456789),
        ("1.764000000123456789e18", 1764000000123456789),
        ("4000000000", 4_000_000_000_000_000_000),
    ],
)
def test_seconds_become_exact_nanoseconds(text: str, stamp_ns: int) -> None:
    assert trajectory.nanoseconds(text) == stamp_ns


@pytest.mark.parametrize("text", ["", "now", "nan", "inf"])
def test_text_that_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a time in seconds"):
        trajectory.nanoseconds(text)


def test_stamp_beyond_any_clock_is_named_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text("0 1 2 3 0 0 0 1\n1e19 1 2 3 0 0 0 1\n")  # nanoseconds taken for seconds
    with pytest.raises(SegslamError, match=r"poses\.txt:2: 1e19 s are more than 292 years"):
        trajectory.read_poses(file)


def test_correction_changes_nothing_where_the_graph_changed_nothing() -> None:
    T_odom_lidar = _drive(np.random.default_rng(6), 40)
    rows = np.array([3, 10, 11, 33])
    corrected = trajectory.corrected_poses(T_odom_lidar, rows, T_odom_lidar[rows])
    np.testing.assert_allclose(corrected, T_odom_lidar, atol=1e-12)


def test_correction_is_exact_at_keyframes_and_carries_the_odometry_between() -> None:
    rng = np.random.default_rng(7)
    T_odom_lidar = _drive(rng, 30)
    rows = np.array([0, 12, 29])
    turns = 0.02 * rng.normal(size=(3, 3))
    noise = [geometry.exp(geometry.tangent(rotation_rad=turn, translation_m=[1.0, 1.0, 1.0])) for turn in turns]
    T_world_keyframe = T_odom_lidar[rows] @ np.array(noise)
    corrected = trajectory.corrected_poses(T_odom_lidar, rows, T_world_keyframe)
    np.testing.assert_array_equal(corrected[rows], T_world_keyframe)
    steps = np.linalg.inv(corrected[:-1]) @ corrected[1:]
    odometry_steps = np.linalg.inv(T_odom_lidar[:-1]) @ T_odom_lidar[1:]
    # the corrections differ by some 1 m over 12 scans or more, so no step may change by more than a fraction of that
    assert np.abs(steps - odometry_steps)[:, :3, 3].max() < 0.3


def test_correction_grows_with_the_share_of_the_way() -> None:
    T_odom_lidar = np.tile(np.eye(4), (4, 1, 1))
    T_odom_lidar[:, 0, 3] = [0.0, 1.0, 4.0, 4.0]
    T_world_keyframe = T_odom_lidar[[0, 3]].copy()
    T_world_keyframe[1, 1, 3] = 2.0
    corrected = trajectory.corrected_poses(T_odom_lidar, np.array([0, 3]), T_world_keyframe)
    np.testing.assert_allclose(corrected[:, 1, 3], [0.0, 0.5, 2.0, 2.0], atol=1e-8)


def test_correction_while_standing_goes_by_the_scans() -> None:
    T_world_keyframe = np.tile(np.eye(4), (2, 1, 1))
    T_world_keyframe[1, 0, 3] = 1.0
    corrected = trajectory.corrected_poses(np.tile(np.eye(4), (5, 1, 1)), np.array([0, 4]), T_world_keyframe)
    np.testing.assert_allclose(corrected[:, 0, 3], [0, 0.25, 0.5, 0.75, 1])


def test_ends_beyond_the_keyframes_move_rigidly_with_the_nearest() -> None:
    T_odom_lidar = _drive(np.random.default_rng(8), 12)
    shift = geometry.exp(geometry.tangent(rotation_rad=[0, 0, 0.3], translation_m=[5.0, 0, 0]))
    corrected = trajectory.corrected_poses(T_odom_lidar, np.array([4]), shift @ T_odom_lidar[[4]])
    np.testing.assert_allclose(corrected, shift @ T_odom_lidar, atol=1e-12)


@pytest.mark.parametrize("rows", [[], [0, 1]])
def test_correction_needs_a_pose_for_each_keyframe(rows: list[int]) -> None:
    with pytest.raises(ValueError, match="keyframes"):
        trajectory.corrected_poses(np.tile(np.eye(4), (3, 1, 1)), np.array(rows, dtype=int), np.eye(4)[None])


@pytest.mark.data
def test_official_ground_truth_reads_with_its_length(data_dir: Path) -> None:
    assert len(trajectory.read_poses(data_dir / "kitti" / "poses" / "04.txt")) == 271


def test_the_way_to_another_drive_is_neither_travelled_nor_drawn() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 9.0, 11.0]
    np.testing.assert_array_equal(trajectory.travelled_m(poses), [0.0, 1.0, 9.0, 11.0])
    np.testing.assert_array_equal(trajectory.travelled_m(poses, [2]), [0.0, 1.0, 1.0, 3.0])
    np.testing.assert_array_equal(trajectory.travelled_m(poses, [0, 4]), trajectory.travelled_m(poses))
    np.testing.assert_array_equal(trajectory.parted(np.arange(4), [2]), [0.0, 1.0, np.nan, 2.0, 3.0])
