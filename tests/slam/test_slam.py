import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from helpers.drives import SLAM_CONFIG, drifting_slam, round_drive

from segslam.core.config import load_config
from segslam.core.evaluation import trajectory_metrics
from segslam.core.threads import in_other_thread
from segslam.core.types import BadScan, LoopAttempt, LoopClosure, Rejected, Scan, SegslamError, Step
from segslam.output.accuracy import accuracy
from segslam.slam.slam import Slam, SlamResult, Tracked


@pytest.fixture(scope="module")
def run() -> tuple[list[Step], SlamResult]:
    slam = drifting_slam()
    steps = [slam.process(scan) for scan in round_drive()[0]]
    return steps, slam.finish()


def test_loops_take_the_drift_out(run: tuple[list[Step], SlamResult]) -> None:
    _, result = run
    figures = accuracy(result, round_drive()[1])
    assert figures["num_loops_false"] == 0
    assert len(result.estimate.closure_weights) >= 3
    assert figures["odometry_ate_m"] > 0.5, "the drift to be taken out"
    assert figures["ate_m"] < 0.4 * figures["odometry_ate_m"]


def test_every_scan_has_a_pose_and_keyframes_have_the_graph_s(run: tuple[list[Step], SlamResult]) -> None:
    steps, result = run
    assert result.trajectory.scan_index.tolist() == [scan.index for scan in round_drive()[0]]
    for keyframe_id, T_world_keyframe in result.estimate.T_world_keyframe.items():
        row = result.keyframe_rows[keyframe_id]
        np.testing.assert_allclose(result.trajectory.T_world_lidar[row], T_world_keyframe, atol=1e-9)
    assert [step.keyframe.id for step in steps if step.keyframe] == list(range(len(result.keyframe_rows)))


def test_a_step_holds_an_estimate_exactly_when_a_loop_was_accepted(run: tuple[list[Step], SlamResult]) -> None:
    for step in run[0]:
        accepted = [attempt for attempt in step.attempts if isinstance(attempt.outcome, LoopClosure)]
        assert (step.estimate is not None) == bool(accepted)


def test_repeating_the_steps_gives_the_same_attempts_and_poses(run: tuple[list[Step], SlamResult]) -> None:
    steps, result = run
    slam = Slam(SLAM_CONFIG)
    again = [slam.repeat(step) for step in steps]
    repeated = slam.finish()
    np.testing.assert_allclose(repeated.trajectory.T_world_lidar, result.trajectory.T_world_lidar, atol=1e-9)
    outcomes = [[_outcome(attempt.outcome) for attempt in step.attempts] for step in steps]
    assert [[_outcome(attempt.outcome) for attempt in step.attempts] for step in again] == outcomes


@pytest.mark.long
@pytest.mark.parametrize(
    ("max_waiting", "slow"),
    [(1, "tracking"), *(pytest.param(8, one, marks=pytest.mark.slow) for one in ("closing", "neither"))],
)
def test_steps_do_not_depend_on_how_far_tracking_is_ahead(
    run: tuple[list[Step], SlamResult], max_waiting: int, slow: str
) -> None:
    steps, result = run
    slam = drifting_slam()

    def tracked() -> Iterator[Tracked]:
        for scan in round_drive()[0]:
            time.sleep(0.01 * (slow == "tracking"))
            yield slam.track(scan)

    def closed(scan: Tracked) -> Step:
        time.sleep(0.02 * (slow == "closing"))
        return slam.close_loops(scan)

    for step, expected in zip(in_other_thread(tracked(), closed, max_waiting=max_waiting), steps, strict=True):
        assert step.scan_index == expected.scan_index
        np.testing.assert_array_equal(step.T_odom_lidar, expected.T_odom_lidar)
        assert (step.keyframe is None) == (expected.keyframe is None)
        if step.keyframe is not None:
            np.testing.assert_array_equal(step.keyframe.points, expected.keyframe.points)
            assert (step.keyframe.id, step.keyframe.travel_m) == (expected.keyframe.id, expected.keyframe.travel_m)
        assert [_exactly(attempt) for attempt in step.attempts] == [_exactly(attempt) for attempt in expected.attempts]
    np.testing.assert_array_equal(slam.finish().trajectory.T_world_lidar, result.trajectory.T_world_lidar)


@pytest.mark.long
def test_a_smaller_share_of_false_loops_on_the_same_steps_reject_what_was_accepted(
    run: tuple[list[Step], SlamResult],
) -> None:
    slam = Slam(
        load_config(None, ["proximity.min_travel_m=60", "verify.max_false_share=1e-300", "adjustment.max_minutes=0"])
    )
    for step in run[0]:
        slam.repeat(step)
    result = slam.finish()
    assert result.estimate.closure_weights == {}
    np.testing.assert_allclose(
        trajectory_metrics(result.trajectory.T_world_lidar, result.odometry.T_world_lidar)["ate_m"], 0.0, atol=1e-6
    )


def test_a_bad_scan_is_forgotten() -> None:
    scans, _ = round_drive()
    slam = drifting_slam()
    slam.process(scans[0])
    empty = Scan(np.empty((0, 3), np.float32), scans[1].stamp_ns)
    with pytest.raises(BadScan):
        slam.process(empty)
    slam.process(scans[2])
    assert slam.finish().trajectory.scan_index.tolist() == [0, 2]


def test_there_is_no_end_without_a_beginning() -> None:
    with pytest.raises(SegslamError, match="no scan"):
        Slam(SLAM_CONFIG).finish()


def _exactly(attempt: LoopAttempt) -> tuple[object, ...]:
    pair = (attempt.candidate.source_id, attempt.candidate.target_id)
    if isinstance(attempt.outcome, Rejected):
        return (*pair, attempt.outcome)
    return (*pair, attempt.outcome.T_target_source.tolist(), attempt.outcome.information.tolist())


def _outcome(outcome: LoopClosure | Rejected) -> str:
    if isinstance(outcome, Rejected):
        return f"{outcome.reason} {outcome.detail}"
    return np.array2string(outcome.T_target_source, precision=10)


def test_a_scan_that_is_not_later_than_the_last_is_refused_and_forgotten() -> None:
    scans = round_drive()[0][:3]
    slam = drifting_slam()
    slam.process(scans[1])
    for older in (scans[1], scans[0]):
        with pytest.raises(BadScan, match=rf"scan {older.index}: its stamp .* is not later than .*{scans[1].stamp_ns}"):
            slam.process(older)
    slam.process(scans[2])
    assert slam.finish().trajectory.scan_index.tolist() == [1, 2]


def test_a_second_scan_with_an_index_is_refused_and_forgotten() -> None:
    scans = round_drive()[0][:4]
    slam = drifting_slam()
    slam.process(scans[1])
    with pytest.raises(BadScan, match="scan 1: an earlier scan has this index; give each its own"):
        slam.process(replace(scans[2], index=1))
    slam.process(replace(scans[2], index=None))
    slam.process(scans[3])
    assert slam.finish().trajectory.scan_index.tolist() == [1, 2, 3]


def test_no_scan_is_taken_after_the_end() -> None:
    scans = round_drive()[0][:2]
    slam = drifting_slam()
    slam.process(scans[0])
    slam.finish()
    with pytest.raises(SegslamError, match="scan 1: the run is finished"):
        slam.process(scans[1])


def test_a_scan_whose_labels_cannot_be_read_remains_in_the_drive() -> None:
    def cut() -> np.ndarray:
        raise BadScan("labels of scan 1: cut")

    slam = drifting_slam()
    for scan in round_drive()[0][:3]:
        slam.process(replace(scan, labels=cut) if scan.index == 1 else scan)
    result = slam.finish()
    assert result.trajectory.scan_index.tolist() == [0, 1, 2]
    assert result.trajectory.scan_index[result.keyframe_rows].tolist() == [0, 1, 2]


def test_the_end_comes_once() -> None:
    slam = drifting_slam()
    slam.process(round_drive()[0][0])
    assert slam.finish() is slam.finish()
