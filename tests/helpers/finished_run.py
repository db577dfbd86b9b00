"""A generated run folder: a drive around a block and a little farther, with known loops, one of them false."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config, config_to_yaml
from segslam.core.trajectory import corrected_poses
from segslam.core.types import (
    Alignment,
    GraphEstimate,
    Keyframe,
    LoopAttempt,
    LoopCandidate,
    LoopClosure,
    Registration,
    Rejected,
    RejectReason,
    Step,
    Trajectory,
)
from segslam.output.folder import write_metrics
from segslam.output.log import LogWriter
from segslam.slam.slam import SlamResult

FIRST_SCAN = 5
NUM_SCANS = 120
STEP_M = 2.0
ROUND = 100  # scans
T_CAMERA_LIDAR = geometry.transform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.0, -0.08, -0.27]))
METRICS = {
    "num_scans": NUM_SCANS,
    "num_scans_skipped": 1,
    "num_keyframes": NUM_SCANS // 2,
    "num_candidates": 10,
    "num_loops_accepted": 4,
    "seconds_total": 12.0,
    "scans_per_second": 10.0,
    "peak_rss_mb": 400.0,
    "stage_ms": {"odometry": {"median": 40.0, "p95": 60.0}, "match": {"median": 6.0, "p95": 11.0}},
}


def write_blank_report(folder: Path) -> None:
    """In place of `write_report`, which takes longer than mapping a few scans."""
    (folder / "report.html").write_text("")


@dataclass(frozen=True, eq=False)
class MadeRun:
    folder: Path
    truth: Trajectory
    result: SlamResult


def make_run(folder: Path, *, with_truth: bool = True, finished: bool = True) -> MadeRun:
    """Write the run. Of its four closures the last is false."""
    folder.mkdir(parents=True)
    truth = _truth()
    odometry = _drifting(truth)
    rows = np.arange(0, NUM_SCANS, 2)
    attempts = tuple(_attempt(place, truth.T_world_lidar[rows]) for place in range(50, 60))
    T_world_keyframe = dict(enumerate(truth.T_world_lidar[rows]))
    estimate = GraphEstimate(T_world_keyframe, 1.5, {(50, 0): 1.0, (52, 2): 0.9, (54, 4): 1.0, (56, 6): 0.0})
    corrected = replace(truth, T_world_lidar=corrected_poses(odometry.T_world_lidar, rows, truth.T_world_lidar[rows]))
    config = Config()
    (folder / "config.yaml").write_text(config_to_yaml(config))
    log = LogWriter(
        folder / "log.mcap",
        config=config,
        dataset="kitti/00",
        T_camera_lidar=T_CAMERA_LIDAR,
        reference=truth if with_truth else None,
    )
    for row in range(NUM_SCANS):
        log.write(_step(row, odometry, attempts))
    if finished:
        log.write_result(estimate, corrected)
    log.close()
    write_metrics(folder, METRICS)
    return MadeRun(folder, truth, SlamResult(corrected, odometry, estimate, rows, attempts))


def _truth() -> Trajectory:
    angles = 2 * np.pi * np.arange(NUM_SCANS) / ROUND
    radius_m = ROUND * STEP_M / (2 * np.pi)
    poses = [
        geometry.transform(geometry.yaw(a), [radius_m * np.sin(a), radius_m * (1 - np.cos(a)), 0.0]) for a in angles
    ]
    scans = FIRST_SCAN + np.arange(NUM_SCANS)
    return Trajectory(scans, scans * 100_000_000, np.array(poses))


def _drifting(truth: Trajectory) -> Trajectory:
    error = geometry.exp(geometry.tangent(rotation_rad=[0, 0, 0.001], translation_m=[0.0, 0.0, 0.01]))
    poses = [np.eye(4)]
    for before, after in zip(truth.T_world_lidar[:-1], truth.T_world_lidar[1:], strict=True):
        poses.append(poses[-1] @ geometry.inverse(before) @ after @ error)
    return replace(truth, T_world_lidar=np.array(poses))


def _attempt(place: int, T_world_keyframe: np.ndarray) -> LoopAttempt:
    """Even keyframes close, odd ones are rejected, and so are the last two; the closure of 56 is 3 m off."""
    pair = (place, place - 50)
    T_target_source = geometry.inverse(T_world_keyframe[pair[1]]) @ T_world_keyframe[pair[0]]
    candidate = LoopCandidate(*pair, T_target_source, geometry.distance(T_target_source))
    if place % 2 or place >= 58:
        reason = RejectReason.SMALL_CLIQUE if place % 2 else RejectReason.LOW_OVERLAP
        return LoopAttempt(candidate, Rejected(reason, "3 < 5"), {"match": 0.01})
    if place == 56:
        T_target_source = T_target_source @ geometry.transform(np.eye(3), [3.0, 0.0, 0.0])
    registration = Registration(T_target_source, 100, 12, 0.1, np.eye(6))
    alignment = Alignment(registration, registration, 0.8, 0.1, 0.01)
    return LoopAttempt(candidate, LoopClosure(*pair, T_target_source, np.eye(6), alignment), {"match": 0.01})


def _step(row: int, odometry: Trajectory, attempts: tuple[LoopAttempt, ...]) -> Step:
    scan, stamp_ns = int(odometry.scan_index[row]), int(odometry.stamp_ns[row])
    T_odom_lidar = odometry.T_world_lidar[row]
    keyframe = None
    if row % 2 == 0:
        points = np.ones((4, 3), dtype=np.float32)
        keyframe = Keyframe(row // 2, scan, stamp_ns, T_odom_lidar, STEP_M * row, points, np.zeros(4, dtype=np.uint8))
    own = tuple(attempt for attempt in attempts if keyframe and attempt.candidate.source_id == keyframe.id)
    return Step(scan, stamp_ns, T_odom_lidar, keyframe, own, None, {"odometry": 0.04 + 0.001 * (row % 7)})
