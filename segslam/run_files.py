"""The files of a run's folder that a person or a script reads afterwards."""

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from segslam.trajectory import camera_from_lidar, write_kitti, write_tum
from segslam.types import LoopAttempt, LoopClosure, SegslamError, Trajectory, Transform, WorkFailed

POSE_COLUMNS = tuple(f"T{row}{column}" for row in range(4) for column in range(4))
STAGES = ("prepare", "match", "refine", "verify")
LOG = "log.mcap"
UNFINISHED = ".part"
"""Suffix of files that take the place of others when they are whole."""


def new_folder(folder: Path) -> Path:
    """An empty folder for a run. Raises SegslamError if there is anything in it, for nothing written is ever lost."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise SegslamError(f"{folder}: not empty; name another folder with --out, or remove it")
    except OSError as error:
        raise SegslamError(f"{folder}: cannot be written to ({error.strerror}); name another with --out") from error
    return folder


def write_poses(folder: Path, name: str, trajectory: Trajectory, T_camera_lidar: Transform | None) -> None:
    """`NAME_tum.txt` in the LiDAR frame, and `NAME_kitti.txt`, in the camera frame where there is one."""
    poses = trajectory.T_world_lidar
    write_tum(folder / f"{name}_tum.txt", trajectory.stamp_ns, poses)
    if T_camera_lidar is not None:
        poses = camera_from_lidar(poses, T_camera_lidar)
    write_kitti(folder / f"{name}_kitti.txt", poses)


def write_loops(file: Path, attempts: tuple[LoopAttempt, ...], weights: dict[tuple[int, int], float]) -> None:
    """A row for every attempt; cells that do not apply are empty. `weight` is the graph's final trust, 0 to 1."""
    head = ("source", "target", "outcome", "detail", "distance_m", "correspondences", "inliers", "overlap", "rms_m")
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow((*head, "free_space_violation", "weight", *POSE_COLUMNS, *(f"{stage}_s" for stage in STAGES)))
        writer.writerows(_loop_row(attempt, weights) for attempt in attempts)


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """`metrics.json`, whole or not at all; a figure that is unknown is left out by the caller."""
    text = json.dumps(metrics, indent=2, allow_nan=False)
    part = folder / ("metrics.json" + UNFINISHED)
    with room_for(folder):
        part.write_text(text + "\n", encoding="utf-8")
        part.replace(folder / "metrics.json")


@contextmanager
def room_for(folder: Path) -> Iterator[None]:
    """Raises WorkFailed where the disk does not take what is written within."""
    try:
        yield
    except OSError as error:
        raise WorkFailed(
            f"{folder}: cannot write the results ({error.strerror}); make room on the disk and resume: the log has all"
        ) from error


def _loop_row(attempt: LoopAttempt, weights: dict[tuple[int, int], float]) -> list[object]:
    candidate, outcome = attempt.candidate, attempt.outcome
    ids = (candidate.source_id, candidate.target_id)
    seconds = [f"{attempt.seconds[stage]:.6f}" if stage in attempt.seconds else "" for stage in STAGES]
    if not isinstance(outcome, LoopClosure):
        nothing = [""] * (6 + len(POSE_COLUMNS))
        return [*ids, outcome.reason.value, outcome.detail, candidate.distance_m, *nothing, *seconds]
    found = outcome.alignment
    figures = (found.coarse.num_correspondences, found.coarse.num_inliers, found.overlap, found.rms_m)
    last = (found.free_space_violation, weights[ids], *outcome.T_target_source.ravel())
    return [*ids, "accepted", "", candidate.distance_m, *figures, *last, *seconds]
