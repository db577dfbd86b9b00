"""Rows that belong together, and the correction of all scans."""

import numpy as np
import pytest
from helpers.drives import random_path
from hypothesis import given, settings
from hypothesis import strategies as st

from segslam.core import geometry, trajectory


def test_camera_and_lidar_frames_undo_each_other_and_start_at_the_origin() -> None:
    poses = random_path(np.random.default_rng(4), 5)
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


def test_correction_changes_nothing_where_the_graph_changed_nothing() -> None:
    T_odom_lidar = random_path(np.random.default_rng(6), 40)
    rows = np.array([3, 10, 11, 33])
    corrected = trajectory.corrected_poses(T_odom_lidar, rows, T_odom_lidar[rows])
    np.testing.assert_allclose(corrected, T_odom_lidar, atol=1e-12)


def test_correction_is_exact_at_keyframes_and_carries_the_odometry_between() -> None:
    rng = np.random.default_rng(7)
    T_odom_lidar = random_path(rng, 30)
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
    T_odom_lidar = random_path(np.random.default_rng(8), 12)
    shift = geometry.exp(geometry.tangent(rotation_rad=[0, 0, 0.3], translation_m=[5.0, 0, 0]))
    corrected = trajectory.corrected_poses(T_odom_lidar, np.array([4]), shift @ T_odom_lidar[[4]])
    np.testing.assert_allclose(corrected, shift @ T_odom_lidar, atol=1e-12)


@pytest.mark.parametrize("rows", [[], [0, 1]])
def test_correction_needs_a_pose_for_each_keyframe(rows: list[int]) -> None:
    with pytest.raises(ValueError, match="keyframes"):
        trajectory.corrected_poses(np.tile(np.eye(4), (3, 1, 1)), np.array(rows, dtype=int), np.eye(4)[None])


def test_the_way_to_another_drive_is_neither_travelled_nor_drawn() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 9.0, 11.0]
    np.testing.assert_array_equal(trajectory.travelled_m(poses), [0.0, 1.0, 9.0, 11.0])
    np.testing.assert_array_equal(trajectory.travelled_m(poses, [2]), [0.0, 1.0, 1.0, 3.0])
    np.testing.assert_array_equal(trajectory.travelled_m(poses, [0, 4]), trajectory.travelled_m(poses))
    np.testing.assert_array_equal(trajectory.parted(np.arange(4), [2]), [0.0, 1.0, np.nan, 2.0, 3.0])
