"""Names and writers of the files in a run folder."""

import csv
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from segslam.core.errors import how_to_write, reason
from segslam.core.pose_files import read_poses, write_kitti, write_tum
from segslam.core.trajectory import camera_from_lidar
from segslam.core.types import (
    Alignment,
    LoopAttempt,
    Mask,
    Rejected,
    SegslamError,
    Trajectory,
    Transform,
    Vector,
    WorkFailed,
)
from segslam.core.whole_files import unless_damaged, whole_file, write_whole

POSE_COLUMNS = tuple(f"T{row}{column}" for row in range(4) for column in range(4))
LOOP_COLUMNS = (
    *("source", "target", "outcome", "detail", "distance_m", "correspondences", "inliers", "overlap", "rms_m"),
    *("free_space_violation", "probability", "evidence", "weight"),
    *POSE_COLUMNS,
    *("prepare_s", "match_s", "refine_s", "verify_s"),
)
LOG = "log.mcap"
PLACE_ON_GLOBE = "georeference.json"
PLACE_FILES = (PLACE_ON_GLOBE, "gnss.csv", "poses_geodetic.csv", "poses_enu_tum.txt")
ADJUSTED_GRAPH = "adjusted.g2o"
"""All edges of the last estimate, with the information with which they act."""
ALONE, ALONE_FILES = "kiss_icp", ("kiss_icp_tum.txt", "kiss_icp_kitti.txt")
"""The files with the poses by KISS-ICP alone, and the start of their names and of their figures."""
UNFINISHED = ".part"
"""Suffix of a file that replaces another when it is complete."""


def log_of(run: Path) -> Path:
    """Path of the log of a run, given its folder or the log."""
    return run / LOG if run.is_dir() else run


def folder_of(run: Path) -> Path:
    """Path of the folder of a run, given the folder or its log."""
    return run.parent if run.is_file() and run.name == LOG else run


def new_folder(folder: Path) -> Path:
    """Create an empty folder for a run. Raises SegslamError if it is not empty, so that no results are overwritten."""
    check_new(folder)
    with writable(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def check_new(folder: Path) -> None:
    """Raises SegslamError if the new folder of a run is not empty."""
    with writable(folder):
        if folder.exists() and any(folder.iterdir()):
            resume = "continue an interrupted run: segslam resume, or replace a run"
            more = resume if (folder / LOG).exists() else "or replace results of this command"
            raise SegslamError(f"{folder}: not empty; give another folder with --out, {more}: --overwrite")


@contextmanager
def writable(folder: Path) -> Iterator[None]:
    """Context manager that raises SegslamError if a new folder cannot be read or written within it."""
    try:
        yield
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


def copy_alone(source: Path, target: Path) -> None:
    """Copy the files of KISS-ICP alone to another run of the same scans, if the first has them."""
    for name in ALONE_FILES:
        if (source / name).is_file():
            write_whole(target / name, (source / name).read_bytes())


def read_alone(folder: Path, scans: Trajectory) -> Trajectory | None:
    """The poses of scans by KISS-ICP alone, if known; the file may go on after them, where a run was repeated in part.

    Raises SegslamError if the file is not one of these scans.
    """
    file = folder / f"{ALONE}_tum.txt"
    if not file.is_file():
        return None
    poses = read_poses(file, format="tum")
    if poses.stamp_ns is None or not np.array_equal(poses.stamp_ns[: len(scans)], scans.stamp_ns):
        raise SegslamError(f"{file}: not of the scans of this run; remove the file")
    return replace(scans, T_world_lidar=poses.T_a_b[: len(scans)])


def write_csv(file: Path, head: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a line of column names and the rows, whole or not at all."""
    with whole_file(file) as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(head)
        writer.writerows(rows)


def write_localised(folder: Path, trajectory: Trajectory, from_map_m: Vector, localised: Mask) -> None:
    """`localised.csv`, one row per scan: whether it is localised, and the travel to a keyframe with a placement."""
    away = (f"{distance_m:.2f}" if np.isfinite(distance_m) else "" for distance_m in from_map_m)
    rows = zip(trajectory.scan_index, trajectory.stamp_ns, localised.astype(int), away, strict=True)
    write_csv(folder / "localised.csv", ("scan", "stamp_ns", "localised", "from_placed_keyframe_m"), rows)


def read_localised(folder: Path, num_scans: int) -> Vector | None:
    """(n,) travel from each scan to a keyframe with a placement, infinite where there is none (m).

    None for a run without `localised.csv`. Raises SegslamError if the file is damaged.
    """
    file = folder / "localised.csv"
    if not file.exists():
        return None
    with unless_damaged(file, "localise the data again"), file.open(newline="", encoding="utf-8") as stream:
        distance_m = np.array([float(row["from_placed_keyframe_m"] or "inf") for row in csv.DictReader(stream)])
    if len(distance_m) != num_scans:
        raise SegslamError(f"{file}: damaged, {len(distance_m)} rows for {num_scans} scans; localise the data again")
    return distance_m


def write_loops(file: Path, attempts: tuple[LoopAttempt, ...], weights: dict[tuple[int, int], float]) -> None:
    """One row per attempt; cells that do not apply are empty. `weight`: final weight in the graph, 0 to 1."""
    rows = (_loop_cells(attempt, weights) for attempt in attempts)
    write_csv(file, LOOP_COLUMNS, ([row.get(name, "") for name in LOOP_COLUMNS] for row in rows))


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
        why = f"({reason(cause)}); {how_to_write(cause)}" if isinstance(cause, OSError) else f"({error})"
        raise WorkFailed(f"{folder}: cannot write the results {why}; the log is complete") from error


def _loop_cells(attempt: LoopAttempt, weights: dict[tuple[int, int], float]) -> dict[str, object]:
    """Column -> content, where it is known; `evidence` as JSON (nats by name)."""
    candidate, outcome = attempt.candidate, attempt.outcome
    cells: dict[str, object] = {
        **{"source": candidate.source_id, "target": candidate.target_id, "distance_m": candidate.distance_m},
        **{f"{stage}_s": f"{seconds:.6f}" for stage, seconds in attempt.seconds.items()},
    }
    judged: Alignment | Rejected
    if isinstance(outcome, Rejected):
        judged = outcome
        cells |= {"outcome": outcome.reason.value, "detail": outcome.detail}
    else:
        judged = found = outcome.alignment
        cells |= {
            "outcome": "accepted",
            "correspondences": found.coarse.num_correspondences,
            "inliers": found.coarse.num_inliers,
            "overlap": found.overlap,
            "rms_m": found.rms_m,
            "free_space_violation": found.free_space_violation,
            "weight": weights[candidate.pair],
            **dict(zip(POSE_COLUMNS, outcome.T_target_source.ravel(), strict=True)),
        }
    if judged.probability is not None:
        evidence = {name: round(value, 2) for name, value in judged.evidence.items()}
        cells |= {"probability": f"{judged.probability:.6f}", "evidence": json.dumps(evidence)}
    return cells
