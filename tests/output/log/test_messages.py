"""Messages in words, and the trajectory from the first keyframe on."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from helpers.made_logs import CONFIG, decoded, write_log

from segslam.core import geometry
from segslam.core.types import LoopClosure, Motion, MotionState, Step
from segslam.output.log import LogWriter, read_log, schema
from segslam.output.log.drawing import INFO, WARNING
from segslam.output.log.foxglove import transforms


def test_repairs_breaks_and_loops_are_messages_and_skipped_scans_warnings(steps: list[Step], tmp_path: Path) -> None:
    told = [
        replace(steps[0], motion=Motion(MotionState.REPAIRED, moved_m=1.234)),
        replace(steps[1], motion=Motion(MotionState.BROKEN)),
        replace(steps[2], motion=Motion(MotionState.CONFIRMED)),
        *steps[3:],
    ]
    with LogWriter(tmp_path / "log.mcap", config=CONFIG) as log:
        for step in told:
            log.write(step)
        log.warn("scan 99: empty; skipped")
    messages = decoded(tmp_path / "log.mcap", schema.LOG)
    texts = [message.message for message in messages]
    assert texts[0] == f"scan {steps[0].scan_index}: motion of the odometry repaired, by 1.23 m"
    assert "break" in texts[1]
    assert texts[-1] == "scan 99: empty; skipped"
    closures = [a.outcome for step in steps for a in step.attempts if isinstance(a.outcome, LoopClosure)]
    assert closures
    assert [text.split(":")[0] for text in texts[2:-1]] == [
        f"loop from keyframe {one.source_id} to {one.target_id}" for one in closures
    ]
    assert [message.level for message in messages] == [WARNING, WARNING, *[INFO] * len(closures), WARNING]
    assert len(list(read_log(tmp_path / "log.mcap").steps())) == len(steps)


def test_the_trajectory_is_there_from_the_first_keyframe_on_and_follows_the_estimates(
    steps: list[Step], tmp_path: Path
) -> None:
    path = write_log(tmp_path / "log.mcap", steps)
    keyframes = [step.keyframe for step in steps if step.keyframe is not None]
    first = next(row for row, step in enumerate(steps) if step.estimate is not None)
    before = [step.keyframe for step in steps[:first] if step.keyframe is not None]
    messages = [message.SerializeToString() for message in decoded(path, schema.TRAJECTORY)]
    drawn = [transforms(PosesInFrame.FromString(message)) for message in messages]
    assert len(drawn[0]) == 1
    np.testing.assert_allclose(drawn[0][0], keyframes[0].T_odom_keyframe, atol=1e-9)
    for poses in drawn[: len(before)]:
        for pose, keyframe in zip(poses, keyframes, strict=False):
            np.testing.assert_allclose(pose, keyframe.T_odom_keyframe, atol=1e-9)
    estimates = [step.estimate for step in steps if step.estimate is not None]
    last = estimates[0].T_world_keyframe
    T_world_odom = last[max(last)] @ geometry.inverse(keyframes[max(last)].T_odom_keyframe)
    after = next(poses for poses in drawn if len(poses) == len(last) + 1)
    np.testing.assert_allclose(after[-1], T_world_odom @ keyframes[len(last)].T_odom_keyframe, atol=1e-9)
