"""Errors against evo and kiss_icp, against known answers, and undefined figures."""

from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st
from kiss_icp.metrics import sequence_error

from segslam.core import geometry
from segslam.core.evaluation import (
    UP,
    align_positions,
    loop_metrics,
    motion_errors,
    pose_errors,
    revisits,
    segment_errors,
    trajectory_metrics,
    upward_axis,
)
from segslam.core.pose_files import read_poses

REAL = [  # camera frame or ground-truth frame: each is scored against the official poses as it is
    ("KITTI_00_ORB", "00", 1.30),
    pytest.param("KITTI_00_SPTAM", "00", 3.74, marks=pytest.mark.long),
    pytest.param("simple_online_00", "00", 4.86, marks=pytest.mark.long),
    ("simple_online_05", "05", 2.29),
    ("simple_online_07", "07", 0.78),
]


def _drive(seed: int, num_poses: int, step_m: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(num_poses - 1):
        step = geometry.tangent(rotation_rad=0.05 * rng.normal(size=3), translation_m=[step_m, 0.0, 0.0])
        poses.append(poses[-1] @ geometry.exp(step))
    return np.array(poses)


def _motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return geometry.exp(geometry.tangent(rotation_rad=rng.normal(size=3), translation_m=10 * rng.normal(size=3)))


def _noisy(poses: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = [
        geometry.exp(geometry.tangent(rotation_rad=0.01 * rng.normal(size=3), translation_m=0.2 * rng.normal(size=3)))
        for _ in poses
    ]
    return poses @ np.array(noise)


def _evo(metric: metrics.PE, reference: PosePath3D, estimate: PosePath3D) -> float:
    metric.process_data((reference, estimate))
    return metric.get_statistic(metrics.StatisticsType.rmse)


@pytest.mark.long
@pytest.mark.data
@pytest.mark.parametrize(("name", "sequence", "known_ate_m"), REAL)
def test_real_estimates_are_scored_as_evo_and_kitti_score_them(
    data_dir: Path, name: str, sequence: str, known_ate_m: float
) -> None:
    files = data_dir / "trajectories" / f"{name}.txt", data_dir / "kitti" / "poses" / f"{sequence}.txt"
    estimate, reference = (read_poses(file).T_a_b for file in files)
    ours = trajectory_metrics(estimate, reference, up=UP["-y"])
    assert ours["ate_m"] == pytest.approx(known_ate_m, abs=0.005)

    evo_estimate, evo_reference = (file_interface.read_kitti_poses_file(file) for file in files)
    relative = {
        "rpe_m": metrics.RPE(metrics.PoseRelation.translation_part),
        "rpe_deg": metrics.RPE(metrics.PoseRelation.rotation_angle_deg),
    }
    by_evo = {key: _evo(metric, evo_reference, evo_estimate) for key, metric in relative.items()}
    evo_estimate.align(evo_reference)
    by_evo["ate_m"] = _evo(metrics.APE(metrics.PoseRelation.translation_part), evo_reference, evo_estimate)
    by_evo["are_deg"] = _evo(metrics.APE(metrics.PoseRelation.rotation_angle_deg), evo_reference, evo_estimate)
    for key, value in by_evo.items():
        assert ours[key] == pytest.approx(value, abs=1e-6), key

    translation_percent, rotation_deg_per_m = sequence_error(reference, estimate)  # in single precision
    assert ours["kitti_translation_percent"] == pytest.approx(translation_percent, rel=1e-3)
    assert ours["kitti_rotation_deg_per_100m"] == pytest.approx(100 * rotation_deg_per_m, rel=1e-3)


def test_noisy_estimate_is_scored_as_evo_scores_it() -> None:
    reference = _drive(0, 200)
    estimate = _motion(1) @ _noisy(reference, 2)
    ours = trajectory_metrics(estimate, reference)
    evo_reference, evo_estimate = PosePath3D(poses_se3=list(reference)), PosePath3D(poses_se3=list(estimate))
    assert ours["rpe_m"] == pytest.approx(
        _evo(metrics.RPE(metrics.PoseRelation.translation_part), evo_reference, evo_estimate), abs=1e-9
    )
    assert ours["rpe_deg"] == pytest.approx(
        _evo(metrics.RPE(metrics.PoseRelation.rotation_angle_deg), evo_reference, evo_estimate), abs=1e-9
    )
    evo_estimate.align(evo_reference)
    assert ours["ate_m"] == pytest.approx(
        _evo(metrics.APE(metrics.PoseRelation.translation_part), evo_reference, evo_estimate), abs=1e-9
    )
    assert ours["are_deg"] == pytest.approx(
        _evo(metrics.APE(metrics.PoseRelation.rotation_angle_deg), evo_reference, evo_estimate), abs=1e-9
    )


@given(st.integers(0, 2**31))
def test_alignment_finds_any_rigid_motion(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(10, 3))
    T_target_source = _motion(seed)
    np.testing.assert_allclose(
        align_positions(points, geometry.apply(T_target_source, points)), T_target_source, atol=1e-12
    )


def test_alignment_is_a_rotation_even_where_a_mirror_fits_better() -> None:
    points = np.random.default_rng(3).normal(size=(30, 3))
    assert np.linalg.det(align_positions(points, points * [1, 1, -1])[:3, :3]) == pytest.approx(1.0)


def test_no_other_rigid_motion_aligns_better() -> None:
    rng = np.random.default_rng(4)
    source = rng.normal(size=(40, 3))
    target = source + 0.3 * rng.normal(size=(40, 3))
    T_target_source = align_positions(source, target)

    def cost(T: np.ndarray) -> float:
        return float(np.square(geometry.apply(T, source) - target).sum())

    for _ in range(20):
        nearby = geometry.exp(
            geometry.tangent(rotation_rad=0.01 * rng.normal(size=3), translation_m=0.01 * rng.normal(size=3))
        )
        assert cost(nearby @ T_target_source) > cost(T_target_source)


def test_alignment_needs_as_many_points_on_both_sides() -> None:
    with pytest.raises(ValueError, match="cannot align 2 points with 3"):
        align_positions(np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="cannot align 0 points"):
        align_positions(np.zeros((0, 3)), np.zeros((0, 3)))


def test_moving_the_whole_estimate_changes_no_figure() -> None:
    reference = _drive(5, 300)
    estimate = _noisy(reference, 6)
    moved = trajectory_metrics(_motion(7) @ estimate, reference)
    assert moved == pytest.approx(trajectory_metrics(estimate, reference), abs=1e-9)


def test_truth_itself_has_no_error() -> None:
    reference = _drive(8, 300)
    result = trajectory_metrics(reference, reference)
    assert set(result) == {
        "ate_m", "are_deg", "height_m", "rpe_m", "rpe_deg", "kitti_translation_percent", "kitti_rotation_deg_per_100m",
    }  # fmt: skip
    assert max(result.values()) < 1e-9


def test_height_is_measured_along_up_alone() -> None:
    corners = np.array([[0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0]], dtype=float)
    reference = np.array([geometry.transform(np.eye(3), corner) for corner in corners])
    estimate = reference.copy()
    estimate[:, 2, 3] = [0.5, -0.5, 0.5, -0.5]  # a twist that no rotation takes away
    result = trajectory_metrics(estimate, reference)
    assert result["height_m"] == pytest.approx(0.5)
    assert trajectory_metrics(estimate, reference, up=(0.0, 1.0, 0.0))["height_m"] == pytest.approx(0.0, abs=1e-9)


def test_figures_that_cannot_be_known_are_left_out() -> None:
    assert trajectory_metrics(_drive(9, 2), _drive(9, 2)) == {}
    straight = np.tile(np.eye(4), (20, 1, 1))
    straight[:, 0, 3] = np.arange(20)
    assert set(trajectory_metrics(straight, straight)) == {"ate_m", "rpe_m", "rpe_deg"}
    assert set(trajectory_metrics(_noisy(straight, 13), straight)) == {"ate_m", "rpe_m", "rpe_deg"}


def test_errors_of_motions_are_those_of_single_steps() -> None:
    reference = np.tile(np.eye(4), (4, 1, 1))
    reference[:, 0, 3] = np.arange(4)
    estimate = reference.copy()
    estimate[2:, 0, 3] += 0.25
    errors = motion_errors(estimate, reference, np.s_[:-1], np.s_[1:])
    np.testing.assert_allclose(errors.translation_m, [0, 0.25, 0], atol=1e-12)


def test_segments_are_the_brute_force_ones() -> None:
    reference, estimate = _drive(10, 400, step_m=1.3), _drive(11, 400, step_m=1.31)
    travel = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1))])
    expected = []
    for start in range(0, 400, 10):
        for length in range(100, 801, 100):
            end = next((row for row in range(start, 400) if travel[row] > travel[start] + length), None)
            if end is not None:
                error = np.linalg.inv(np.linalg.inv(estimate[start]) @ estimate[end]) @ (
                    np.linalg.inv(reference[start]) @ reference[end]
                )
                expected.append((geometry.distance(error) / length, np.degrees(geometry.angle(error)) / length))
    errors = segment_errors(estimate, reference)
    np.testing.assert_allclose(np.column_stack([errors.translation_m, errors.rotation_deg]), expected, rtol=1e-9)


def test_error_of_a_pose_is_its_distance_and_angle() -> None:
    T_reference_estimate = geometry.transform(geometry.yaw(np.radians(30)), np.array([3.0, 4.0, 0.0]))
    errors = pose_errors((_motion(12) @ T_reference_estimate)[None], _motion(12)[None])
    np.testing.assert_allclose(errors.translation_m, [5.0])
    np.testing.assert_allclose(errors.rotation_deg, [30.0])


def _round_trip() -> np.ndarray:
    """60 m along x in steps of 2 m, then back 1 m beside it, facing ahead all the time."""
    out = [(x, 0.0) for x in range(0, 61, 2)]
    back = [(x, 1.0) for x in range(60, -1, -2)]
    return np.array([geometry.transform(np.eye(3), np.array([x, y, 0.0])) for x, y in out + back])


def test_revisits_are_near_in_space_and_far_in_travel() -> None:
    reference = _round_trip()
    positions = reference[:, :3, 3]
    travel = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    expected = [
        any(
            np.linalg.norm(positions[new] - positions[old]) <= 4 and travel[new] - travel[old] >= 50
            for old in range(new)
        )
        for new in range(len(reference))
    ]
    assert 0 < sum(expected) < 31
    np.testing.assert_array_equal(revisits(reference), expected)


def test_closures_are_judged_by_2_m_and_5_degrees() -> None:
    reference = _round_trip()
    rows = np.array([[61, 0], [60, 1], [59, 2], [58, 3]])
    closures = np.linalg.inv(reference[rows[:, 1]]) @ reference[rows[:, 0]]
    closures[0] = closures[0] @ geometry.transform(np.eye(3), np.array([1.9, 0.0, 0.0]))
    closures[1] = closures[1] @ geometry.transform(np.eye(3), np.array([2.1, 0.0, 0.0]))
    closures[2] = closures[2] @ geometry.transform(geometry.yaw(np.radians(4.9)), np.zeros(3))
    closures[3] = closures[3] @ geometry.transform(geometry.yaw(np.radians(5.1)), np.zeros(3))
    result = loop_metrics(closures, rows, reference)
    assert result["num_loops_false"] == 2
    assert result["loop_precision"] == 0.5


def test_recall_counts_revisits_near_a_true_closure() -> None:
    reference = _round_trip()
    revisiting = np.flatnonzero(revisits(reference))
    middle = revisiting[len(revisiting) // 2]
    rows = np.array([[middle, 61 - middle]])
    true = np.linalg.inv(reference[rows[:, 1]]) @ reference[rows[:, 0]]
    near = np.abs(revisiting - middle) * 2 <= 10  # rows are 2 m apart
    assert loop_metrics(true, rows, reference)["loop_recall"] == pytest.approx(near.mean())
    false = true @ geometry.transform(np.eye(3), np.array([9.0, 0.0, 0.0]))
    assert loop_metrics(false, rows, reference)["loop_recall"] == 0.0


def test_without_closures_or_revisits_there_is_no_precision_or_recall() -> None:
    none = np.empty((0, 4, 4)), np.empty((0, 2), dtype=int)
    assert loop_metrics(*none, _round_trip()) == {"loop_recall": 0.0}
    assert loop_metrics(*none, _round_trip()[:20]) == {}


def test_no_rotation_error_is_given_where_the_turn_about_a_line_is_not_known() -> None:
    """A street that leaves a straight line by 4 cm, in an estimate that is 1 cm off."""
    rng = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (50, 1, 1))
    truth[:, 0, 3] = np.arange(50)
    truth[:, 1, 3] = 0.06 * np.sin(np.arange(50) / 5)
    estimate = truth.copy()
    estimate[:, :3, 3] += 0.006 * rng.normal(size=(50, 3))
    assert "are_deg" not in trajectory_metrics(estimate, truth)
    assert "height_m" in trajectory_metrics(estimate, truth)
    truth[:, 1, 3] *= 100
    estimate[:, 1, 3] *= 100
    estimate[:, 1, 3] = truth[:, 1, 3] + 0.006 * rng.normal(size=50)
    assert trajectory_metrics(estimate, truth)["are_deg"] < 0.1


@pytest.mark.long
@pytest.mark.data
def test_the_upward_axis_of_real_drives_is_found(data_dir: Path) -> None:
    files = {"-y": [*(data_dir / "kitti" / "poses").glob("*.txt"), *(data_dir / "trajectories").glob("*.txt")]}
    files["z"] = [file for file in data_dir.glob("*/poses.txt") if file.parent.name != "kitti"]
    assert len(files["-y"]) > 10
    assert len(files["z"]) > 3
    for up, named in files.items():
        assert {file.name: upward_axis(read_poses(file).T_a_b) for file in named} == dict.fromkeys(
            (file.name for file in named), up
        )


def test_a_path_that_does_not_show_its_upward_axis_has_none() -> None:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(60, 3))
    assert upward_axis(poses) is None
    straight = np.tile(np.eye(4), (60, 1, 1))
    straight[:, 2, 3] = np.arange(60.0)
    assert upward_axis(straight) == "-y"  # a camera that looks ahead
    assert upward_axis(straight[:, [2, 0, 1, 3]][:, :, [2, 0, 1, 3]]) == "z"
    turned = geometry.transform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3)) @ straight
    assert upward_axis(turned) is None  # the frame is not that of the first pose
    assert [upward_axis(straight[:few]) for few in range(3)] == [None] * 3
