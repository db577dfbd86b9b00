"""A finished run, read back from its folder, and true poses from a file brought to its scans."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from segslam.config import Config
from segslam.log import RunLog, read_log
from segslam.slam import SlamResult
from segslam.trajectory import PoseFile, lidar_from_camera, read_poses, rows_of_same_stamp
from segslam.types import LoopAttempt, SegslamError, Trajectory, Transform

STAMP_TOLERANCE_NS = 10_000_000
"""Farthest that the stamps of a scan and of its true pose may be apart."""


FIGURES = {
    "ate_m": "absolute trajectory error after alignment, rms (m)",
    "odometry_ate_m": "the same of the odometry alone (m)",
    "are_deg": "absolute rotation error after alignment, rms (degrees)",
    "height_m": "height error after alignment, rms (m)",
    "rpe_m": "error of the motion from pose to pose, rms (m)",
    "rpe_deg": "rotation error of the motion from pose to pose, rms (degrees)",
    "kitti_translation_percent": "KITTI's translation error over 100 to 800 m (%)",
    "kitti_rotation_deg_per_100m": "KITTI's rotation error over 100 to 800 m (degrees per 100 m)",
    "num_poses": "poses scored",
    "num_scans": "scans mapped",
    "num_scans_skipped": "bad scans left out",
    "num_keyframes": "keyframes",
    "num_candidates": "loop candidates tried",
    "num_loops_accepted": "loops accepted",
    "num_loops_switched_off": "of these switched off by the graph",
    "num_loops_false": "of these false: off by more than 2 m or 5 degrees",
    "loop_precision": "share of the accepted loops that are true",
    "loop_recall": "share of the revisits within 4 m that a true loop closes",
    "seconds_total": "time (s)",
    "scans_per_second": "scans per second",
    "peak_rss_mb": "peak memory (MB)",
}
"""What the figures of `metrics.json` say, in the order in which a person wants them."""


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """What a run's folder holds of it."""

    folder: Path
    dataset: str
    config: Config
    result: SlamResult
    reference: Trajectory | None
    T_camera_lidar: Transform | None
    metrics: dict[str, Any]


def read_run(folder: Path) -> FinishedRun:
    """The run of a folder. Raises SegslamError if it holds none, or one that did not finish."""
    if not folder.is_dir():
        raise SegslamError(f"{folder}: no such folder; name one that `segslam map --out` made")
    log = read_log(folder / "log.mcap")
    return FinishedRun(
        folder=folder,
        dataset=log.run.get("dataset", ""),
        config=log.config,
        result=_result(log),
        reference=log.reference(),
        T_camera_lidar=log.T_camera_lidar,
        metrics=read_metrics(folder),
    )


def read_metrics(folder: Path) -> dict[str, Any]:
    """The figures of `metrics.json`. Raises SegslamError if there are none."""
    file = folder / "metrics.json"
    try:
        return dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise SegslamError(f"{file}: cannot read the run's figures ({error}); replay its log.mcap") from error


def true_poses(file: Path, run: FinishedRun) -> Trajectory:
    """The poses of a KITTI or TUM file, as those of the run's LiDAR: of its scans that have one.

    KITTI rows are found by the scan's number, and are the camera's if the run's data were KITTI's; TUM rows by stamp.
    Raises SegslamError if no scan has one.
    """
    poses = read_poses(file)
    scans = run.result.trajectory
    rows, numbers = _rows_and_scans(poses, scans)
    if len(rows) == 0:
        raise SegslamError(f"{file}: none of its {len(poses)} poses belongs to a scan of {run.folder}")
    T_world_lidar = poses.T_a_b
    if poses.stamp_ns is None and run.T_camera_lidar is not None:
        T_world_lidar = lidar_from_camera(T_world_lidar, run.T_camera_lidar)
    return Trajectory(scans.scan_index[numbers], scans.stamp_ns[numbers], T_world_lidar[rows])


def _rows_and_scans(poses: PoseFile, scans: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a pose file, and of the scans that they are the poses of."""
    if poses.stamp_ns is None:
        known = np.flatnonzero(scans.scan_index < len(poses))
        return scans.scan_index[known], known
    pairs = rows_of_same_stamp(poses.stamp_ns, scans.stamp_ns, max_difference_ns=STAMP_TOLERANCE_NS)
    return pairs[:, 0], pairs[:, 1]


def _result(log: RunLog) -> SlamResult:
    final = log.result()
    if final is None:
        raise SegslamError(f"{log.path}: the run did not finish; `segslam replay` it, or map the data again")
    estimate, trajectory = final
    T_odom_lidar, keyframe_rows = [], []
    attempts: list[LoopAttempt] = []
    for row, step in enumerate(log.steps(clouds=False)):
        T_odom_lidar.append(step.T_odom_lidar)
        attempts += step.attempts
        if step.keyframe is not None:
            keyframe_rows.append(row)
    if len(T_odom_lidar) < len(trajectory):
        left = f"{len(T_odom_lidar)} of its {len(trajectory)} steps are left"
        raise SegslamError(f"{log.path}: damaged, {left}; replay it, or map the data again")
    odometry = Trajectory(trajectory.scan_index, trajectory.stamp_ns, np.array(T_odom_lidar))
    return SlamResult(trajectory, odometry, estimate, np.array(keyframe_rows), tuple(attempts))
