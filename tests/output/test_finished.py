"""A finished run read back, and true poses brought to its scans."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.finished_run import FIRST_SCAN, METRICS, NUM_SCANS, T_CAMERA_LIDAR, make_run

from segslam.core.pose_files import write_kitti, write_tum
from segslam.core.trajectory import camera_from_lidar
from segslam.core.types import LoopClosure, SegslamError
from segslam.output.accuracy import accuracy
from segslam.output.finished import read_run, true_poses


def test_run_comes_back_as_it_was(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    run = read_run(made.folder)
    assert run.dataset == "kitti/00"
    assert run.metrics == METRICS
    assert run.reference is not None
    for read, written in (
        (run.result.trajectory, made.result.trajectory),
        (run.result.odometry, made.result.odometry),
        (run.reference, made.truth),
    ):
        np.testing.assert_array_equal(read.scan_index, written.scan_index)
        np.testing.assert_array_equal(read.stamp_ns, written.stamp_ns)
        np.testing.assert_allclose(read.T_world_lidar, written.T_world_lidar, atol=1e-12)
    np.testing.assert_array_equal(run.result.keyframe_rows, made.result.keyframe_rows)
    np.testing.assert_array_equal(run.T_camera_lidar, T_CAMERA_LIDAR)
    assert [attempt.candidate.source_id for attempt in run.result.attempts] == list(range(50, 60))
    assert sum(isinstance(attempt.outcome, LoopClosure) for attempt in run.result.attempts) == 4
    assert run.result.estimate.closure_weights == made.result.estimate.closure_weights


def test_figures_of_a_read_run_are_those_of_the_run(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    run = read_run(made.folder)
    assert run.reference is not None
    assert accuracy(run.result, run.reference) == pytest.approx(accuracy(made.result, made.truth), abs=1e-9)


def test_kitti_truth_is_found_by_scan_number_and_leaves_the_camera(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run", with_truth=False)
    run = read_run(made.folder)
    assert run.reference is None
    poses = np.tile(np.eye(4), (FIRST_SCAN + NUM_SCANS + 30, 1, 1))  # the file starts at scan 0 and ends after the run
    poses[FIRST_SCAN:][:NUM_SCANS] = camera_from_lidar(made.truth.T_world_lidar, T_CAMERA_LIDAR)
    write_kitti(tmp_path / "truth.txt", poses)
    truth = true_poses(tmp_path / "truth.txt", run)
    np.testing.assert_array_equal(truth.scan_index, made.truth.scan_index)
    np.testing.assert_allclose(truth.T_world_lidar, made.truth.T_world_lidar, atol=1e-9)


def test_kitti_truth_that_ends_before_the_run_is_refused(tmp_path: Path) -> None:
    """Of 30 of its scans it would score the first alone, and judge no loop."""
    made = make_run(tmp_path / "run", with_truth=False)
    write_kitti(tmp_path / "truth.txt", np.tile(np.eye(4), (FIRST_SCAN + 30, 1, 1)))
    with pytest.raises(SegslamError, match=r"truth\.txt: 35 poses, but the run has scans up to number 124"):
        true_poses(tmp_path / "truth.txt", read_run(made.folder))


def test_kitti_truth_of_another_length_than_all_the_data_is_refused(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    write_kitti(tmp_path / "truth.txt", np.tile(np.eye(4), (346, 1, 1)))
    folder_of_scans = replace(run, dataset="generic/base", options={"frames": ""})
    with pytest.raises(SegslamError, match="346 poses"):
        true_poses(tmp_path / "truth.txt", folder_of_scans)
    assert len(true_poses(tmp_path / "truth.txt", replace(folder_of_scans, options={"frames": "5:125"}))) == NUM_SCANS


def test_truth_of_a_drive_is_not_that_of_scans_with_other_numbers_and_stamps_in_a_merged_run(tmp_path: Path) -> None:
    """The numbers and stamps of the second session of a merged run belong to other scans of a longer drive."""
    run = read_run(make_run(tmp_path / "run", with_truth=False).folder)
    of_both = {"first_keyframe": 0, "num_scans": NUM_SCANS}
    rows = [{"run": "monday", "stamp_shift_ns": 0} | of_both, {"run": "friday", "stamp_shift_ns": 10**9} | of_both]
    merged = replace(run, options={"sessions": json.dumps(rows)})
    poses = np.tile(np.eye(4), (FIRST_SCAN + NUM_SCANS + 30, 1, 1))
    write_kitti(tmp_path / "kitti.txt", poses)
    with pytest.raises(SegslamError, match=r"kitti\.txt: 155 poses, but the run has scans up to number 124"):
        true_poses(tmp_path / "kitti.txt", merged)
    write_kitti(tmp_path / "kitti.txt", poses[: FIRST_SCAN + NUM_SCANS])
    assert len(true_poses(tmp_path / "kitti.txt", merged)) == NUM_SCANS, "a line for each scan of the merged run"
    write_tum(tmp_path / "tum.txt", run.result.trajectory.stamp_ns, run.result.trajectory.T_world_lidar)
    with pytest.raises(SegslamError, match=r"tum\.txt: matched by stamp, but the merged run has other .* than friday"):
        true_poses(tmp_path / "tum.txt", merged)
    later = replace(run, options={"sessions": json.dumps(rows[:1])})
    assert len(true_poses(tmp_path / "tum.txt", later)) == NUM_SCANS, "no stamp was shifted"
    with pytest.raises(SegslamError, match=r"sessions of the log: .* cannot be read"):
        true_poses(tmp_path / "tum.txt", replace(run, options={"sessions": "[{}]"}))


def test_tum_truth_is_found_by_stamp(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run", with_truth=False)
    rows = np.arange(NUM_SCANS)[::-1][::3]  # every third, in reverse, some milliseconds late
    write_tum(tmp_path / "truth.txt", made.truth.stamp_ns[rows] + 4_000_000, made.truth.T_world_lidar[rows])
    truth = true_poses(tmp_path / "truth.txt", read_run(made.folder))
    assert set(truth.scan_index) == set(made.truth.scan_index[rows])
    expected = made.truth.T_world_lidar[truth.scan_index - FIRST_SCAN]
    np.testing.assert_allclose(truth.T_world_lidar, expected, atol=1e-9)


def test_truth_of_another_drive_is_refused(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    write_tum(tmp_path / "truth.txt", made.truth.stamp_ns + 10**12, made.truth.T_world_lidar)
    with pytest.raises(SegslamError, match=r"truth\.txt: none of its 120 poses belongs to a scan"):
        true_poses(tmp_path / "truth.txt", read_run(made.folder))


def test_folder_without_a_whole_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="nowhere: no such file or folder"):
        read_run(tmp_path / "nowhere")
    with pytest.raises(SegslamError, match=r"log\.mcap"):
        read_run(tmp_path)
    with pytest.raises(SegslamError, match=r"did not finish; continue it \(segslam resume\), or replay its log$"):
        read_run(make_run(tmp_path / "killed", finished=False).folder)
    damaged = make_run(tmp_path / "damaged").folder
    content = bytearray((damaged / "log.mcap").read_bytes())
    middle = len(content) // 2
    content[middle : middle + 2000] = bytes(2000)
    (damaged / "log.mcap").write_bytes(content)
    with pytest.raises(SegslamError, match=rf"log\.mcap: damaged, only \d+ of its {NUM_SCANS} steps are readable"):
        read_run(damaged)
    made = make_run(tmp_path / "run")
    (made.folder / "metrics.json").write_text("{")
    with pytest.raises(SegslamError, match=r"metrics\.json: cannot read"):
        read_run(made.folder)
