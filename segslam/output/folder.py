"""Names and writers of the files in a run folder."""

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from segslam.core.errors import reason
from segslam.core.trajectory import camera_from_lidar, read_poses, write_kitti, write_tum
from segslam.core.types import (
    Alignment,
    LoopAttempt,
    LoopClosure,
    Mask,
    Rejected,
    SegslamError,
    Trajectory,
    Transform,
    Vector,
    WorkFailed,
)
from segslam.core.whole_files import whole_file, write_whole

POSE_COLUMNS = tuple(f"T{row}{column}" for row in range(4) for column in range(4))
STAGES = ("prepare", "match", "refine", "verify")
LOG = "log.mcap"
ADJUSTED_GRAPH = "adjusted.g2o"
"""All edges of the last estimate, with the information with which they act."""
ALONE = "kiss_icp"
"""Start of the names of the files with the poses by KISS-ICP alone."""
UNFINISHED = ".part"
"""Suffix of a file that replaces another when it is complete."""


def log_of(run: Path) -> Path:
    """Path of the log of a run, given its folder or the log."""
    return run if run.is_file() else run / LOG


def folder_of(run: Path) -> Path:
    """Path of the folder of a run, given the folder or its log."""
    return run.parent if run.is_file() and run.name == LOG else run


def new_folder(folder: Path) -> Path:
    """Create an empty folder for a run. Raises SegslamError if it is not empty, so that no results are overwritten."""
    check_new(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SegslamError(f"{folder}: cannot be written ({error.strerror}); give another with --out") from error
    return folder


def check_new(folder: Path) -> None:
    """Raises SegslamError if the new folder of a run is not empty."""
    try:
        if folder.exists() and any(folder.iterdir()):
            raise SegslamError(f"{folder}: not empty; give another folder with --out, or replace a run: --overwrite")
    except OSError as error:
        raise SegslamError(f"{folder}: cannot be written ({error.strerror}); give another with --out") from error


def write_poses(
    folder: Path, name: str, trajectory: Trajectory, T_camera_lidar: Transform | None, *, among: Mask | None = None
) -> None:
    """`NAME_tum.txt` in the LiDAR frame, and `NAME_kitti.txt`, in the camera frame if it is known.

    The TUM file, whose lines have stamps, contains only the poses selected by the mask `among`; the KITTI file has one
    line per scan.
    """
    poses = trajectory.T_world_lidar
    rows = slice(None) if among is None else among
    with whole_file(folder / f"{name}_tum.txt") as part:
        write_tum(part, trajectory.stamp_ns[rows], poses[rows])
    if T_camera_lidar is not None:
        poses = camera_from_lidar(poses, T_camera_lidar)
    with whole_file(folder / f"{name}_kitti.txt") as part:
        write_kitti(part, poses)


def write_alone(folder: Path, alone: Trajectory, T_camera_lidar: Transform | None) -> None:
    """The files of KISS-ICP alone, as `write_poses`."""
    write_poses(folder, ALONE, alone, T_camera_lidar)


def remove_alone(folder: Path) -> None:
    """Remove the files of KISS-ICP alone, whose state is lost when a run is resumed."""
    for name in (f"{ALONE}_tum.txt", f"{ALONE}_kitti.txt"):
        (folder / name).unlink(missing_ok=True)


def copy_alone(source: Path, target: Path) -> None:
    """Copy the files of KISS-ICP alone to another run of the same scans, if the first has them."""
    for name in (f"{ALONE}_tum.txt", f"{ALONE}_kitti.txt"):
        if (source / name).is_file():
            write_whole(target / name, (source / name).read_bytes())


def read_alone(folder: Path, scans: Trajectory) -> Trajectory | None:
    """The poses of all scans by KISS-ICP alone; None if the folder does not contain them.

    Raises SegslamError if the file is not one of these scans.
    """
    file = folder / f"{ALONE}_tum.txt"
    if not file.is_file():
        return None
    poses = read_poses(file, format="tum")
    if poses.stamp_ns is None or not np.array_equal(poses.stamp_ns, scans.stamp_ns):
        raise SegslamError(f"{file}: not of the scans of this run; remove the file")
    return replace(scans, T_world_lidar=poses.T_a_b)


def write_localised(folder: Path, trajectory: Trajectory, from_map_m: Vector, localised: Mask) -> None:
    """`localised.csv`, one row per scan: whether it is localised, and the travel to a keyframe with a placement."""
    with whole_file(folder / "localised.csv") as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(("scan", "stamp_ns", "localised", "from_placed_keyframe_m"))
        for scan, stamp_ns, is_localised, distance_m in zip(
            trajectory.scan_index, trajectory.stamp_ns, localised, from_map_m, strict=True
        ):
            writer.writerow((scan, stamp_ns, int(is_localised), f"{distance_m:.2f}" if np.isfinite(distance_m) else ""))


def read_localised(folder: Path, num_scans: int) -> Vector | None:
    """(n,) travel from each scan to a keyframe with a placement, infinite where there is none (m).

    None for a run without `localised.csv`. Raises SegslamError if the file is damaged.
    """
    file = folder / "localised.csv"
    if not file.exists():
        return None
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            distance_m = np.array([float(row["from_placed_keyframe_m"] or "inf") for row in csv.DictReader(stream)])
    except (KeyError, ValueError, TypeError) as error:
        raise SegslamError(f"{file}: damaged ({error!r}); localise the data again") from error
    if len(distance_m) != num_scans:
        raise SegslamError(f"{file}: damaged, {len(distance_m)} rows for {num_scans} scans; localise the data again")
    return distance_m


def write_loops(file: Path, attempts: tuple[LoopAttempt, ...], weights: dict[tuple[int, int], float]) -> None:
    """One row per attempt; cells that do not apply are empty. `weight`: final weight in the graph, 0 to 1."""
    head = ("source", "target", "outcome", "detail", "distance_m", "correspondences", "inliers", "overlap", "rms_m")
    last = ("free_space_violation", "probability", "evidence", "weight")
    with whole_file(file) as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow((*head, *last, *POSE_COLUMNS, *(f"{stage}_s" for stage in STAGES)))
        writer.writerows(_loop_row(attempt, weights) for attempt in attempts)


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write `metrics.json` atomically; callers omit unknown figures."""
    with room_for(folder):
        write_whole(folder / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n")


@contextmanager
def room_for(folder: Path) -> Iterator[None]:
    """Context manager that raises WorkFailed if a file cannot be written within it."""
    try:
        yield
    except (OSError, WorkFailed) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        why = reason(cause) if isinstance(cause, OSError) else str(error)
        raise WorkFailed(
            f"{folder}: cannot write the results ({why}); free space on the disk; the log is complete"
        ) from error


def _loop_row(attempt: LoopAttempt, weights: dict[tuple[int, int], float]) -> list[object]:
    candidate, outcome = attempt.candidate, attempt.outcome
    ids = (candidate.source_id, candidate.target_id)
    seconds = [f"{attempt.seconds[stage]:.6f}" if stage in attempt.seconds else "" for stage in STAGES]
    if not isinstance(outcome, LoopClosure):
        unknown = [""] * 5
        weight_and_pose = [""] * (1 + len(POSE_COLUMNS))
        judged = _judged_cells(outcome)
        return [
            *ids,
            outcome.reason.value,
            outcome.detail,
            candidate.distance_m,
            *unknown,
            *judged,
            *weight_and_pose,
            *seconds,
        ]
    found = outcome.alignment
    figures = (found.coarse.num_correspondences, found.coarse.num_inliers, found.overlap, found.rms_m)
    last = (found.free_space_violation, *_judged_cells(found), weights[ids], *outcome.T_target_source.ravel())
    return [*ids, "accepted", "", candidate.distance_m, *figures, *last, *seconds]


def _judged_cells(outcome: Alignment | Rejected) -> tuple[str, str]:
    """Probability that the pose is right, and its evidence (nats by name, as JSON); empty if it was not judged."""
    if outcome.probability is None:
        return "", ""
    return f"{outcome.probability:.6f}", json.dumps({name: round(value, 2) for name, value in outcome.evidence.items()})
