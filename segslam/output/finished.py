"""A finished run, read from its folder, and ground-truth poses from a file, matched to its scans."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from segslam.core.config import Config
from segslam.core.errors import brief, counted, unreadable
from segslam.core.pose_files import PoseFormat, read_poses
from segslam.core.trajectory import lidar_from_camera, rows_of_same_stamp
from segslam.core.types import LoopAttempt, Motion, SegslamError, Trajectory, Transform
from segslam.core.whole_files import expanded
from segslam.output.folder import ALONE, LOG, folder_of, read_alone, read_localised
from segslam.output.log import RunLog, read_log
from segslam.output.words import FIGURES
from segslam.slam.adjustment.sweeps import Correction, corrections_of, velocities_of
from segslam.slam.slam import SlamResult

STAMP_TOLERANCE_NS = 10_000_000
"""Largest time difference between a scan and its ground-truth pose."""

COMPARED = {"odometry_": "odometry, after repairs", f"{ALONE}_": "KISS-ICP alone"}
"""Prefixes of figures -> the trajectory that they measure, instead of the corrected one."""
ACCURACY = {
    *("ate_m", "are_deg", "height_m", "rpe_m", "rpe_deg", "kitti_translation_percent"),
    *("kitti_rotation_deg_per_100m", "num_loops_false", "loop_precision", "loop_recall"),
}
"""Figures that need a reference; another reference replaces all of them."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FinishedRun:
    """The content of a run folder."""

    folder: Path
    log: RunLog
    dataset: str
    config: Config
    result: SlamResult
    reference: Trajectory | None
    T_camera_lidar: Transform | None
    metrics: dict[str, Any]
    options: Mapping[str, str]
    """Command-line options of the run other than settings, such as `frames`; empty for a replay."""

    def __repr__(self) -> str:
        scans, error = counted(len(self.result.trajectory), "scan"), self.metrics.get("ate_m")
        return f"FinishedRun({str(self.folder)!r}, {scans}{'' if error is None else f', error {error:.3f} m'})"

    def _repr_html_(self) -> str:
        """The trajectory and the figures, for notebooks."""
        from segslam.output.report import as_html

        return as_html(self)


class Part(NamedTuple):
    """A session in a merged run."""

    first_keyframe: int
    num_scans: int
    stamp_shift_ns: int = 0
    """Its stamps are later by this than those of its data."""
    run: str = ""
    """Its folder."""


def parts_in(text: str) -> list[Part]:
    """The sessions in the options of a log; none if it is not of merged runs. Raises SegslamError if it is damaged."""
    try:
        return [
            Part(int(row["first_keyframe"]), int(row["num_scans"]), int(row["stamp_shift_ns"]), str(row["run"]))
            for row in json.loads(text or "[]")
        ]
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise SegslamError(f"sessions of the log: {brief(text)} cannot be read; merge the runs again") from error


def read_run(folder: str | Path) -> FinishedRun:
    """The run of a folder, or of its log. Raises SegslamError if there is none, or it did not finish."""
    folder = folder_of(expanded(folder))
    if not folder.is_dir():
        what = "not a run" if folder.exists() else "no such file or folder"
        raise SegslamError(f"{folder}: {what}; give a folder made by `segslam map --out`")
    log = read_log(folder)
    result = read_result(log)
    if len(result.odometry) < len(result.trajectory):
        left = f"only {len(result.odometry)} of its {len(result.trajectory)} steps are readable"
        raise SegslamError(f"{log.path}: damaged, {left}; replay it, or map the data again")
    return FinishedRun(
        folder=folder,
        log=log,
        dataset=log.run.get("dataset", ""),
        config=log.config,
        result=replace(result, alone=read_alone(folder, result.odometry)),
        reference=log.reference(),
        T_camera_lidar=log.T_camera_lidar,
        metrics=read_metrics(folder),
        options=log.options,
    )


def read_metrics(folder: Path) -> dict[str, Any]:
    """The figures of `metrics.json`. Raises SegslamError if there are none."""
    file = folder / "metrics.json"
    try:
        return _checked_metrics(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError) as error:
        remedy = f"replay its {LOG}" if (folder / LOG).exists() else "give a folder made by `segslam map --out`"
        raise SegslamError(f"{unreadable(file, 'figures of the run', error)}; {remedy}") from error


def plain_name(key: str) -> str:
    """The name of a figure without the prefix of the trajectory that it measures."""
    return next((key.removeprefix(prefix) for prefix in COMPARED if key.startswith(prefix)), key)


def _checked_metrics(values: Any) -> dict[str, Any]:
    """The figures, without those that are null. Raises ValueError if a figure that is shown is no number."""
    if not isinstance(values, dict):
        raise ValueError("not a JSON object")
    known = {key: value for key, value in values.items() if value is not None}
    times = known.get("stage_ms", {})
    if not isinstance(times, dict) or not all(isinstance(one, dict) for one in times.values()):
        raise ValueError("stage_ms is not a JSON object of objects")
    shown = {key: value for key, value in known.items() if plain_name(key) in FIGURES}
    shown |= {f"stage_ms.{stage}.{name}": one.get(name) for stage, one in times.items() for name in ("median", "p95")}
    for key, value in shown.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{key} is no number")
    return known


def true_poses(
    file: Path, run: FinishedRun, *, format: PoseFormat | None = None, max_difference_ns: int = STAMP_TOLERANCE_NS
) -> Trajectory:
    """Ground-truth LiDAR poses of the scans of a run, from a KITTI or TUM file.

    KITTI rows are matched by scan number; they are camera poses if the data of the run is KITTI's. TUM rows are matched
    by stamp. Raises SegslamError if no scan has a pose, if the number of KITTI rows does not match the run, and for
    stamps of a merged run that were shifted: another scan has them in the file.
    """
    poses, scans = read_poses(file, format=format), run.result.trajectory
    T_world_lidar = poses.T_a_b
    if poses.stamp_ns is None:
        _check_length(file, len(poses), run)
        rows, numbers = scans.scan_index, np.arange(len(scans))
        if run.T_camera_lidar is not None:
            T_world_lidar = lidar_from_camera(T_world_lidar, run.T_camera_lidar)
    elif shifted := [part.run for part in parts_in(run.options.get("sessions", "")) if part.stamp_shift_ns]:
        raise SegslamError(
            f"{file}: matched by stamp, but the merged run has other stamps than {shifted[0]}; score each run, or give "
            "KITTI format, one line per scan"
        )
    else:
        rows, numbers = rows_of_same_stamp(poses.stamp_ns, scans.stamp_ns, max_difference_ns=max_difference_ns).T
    if len(rows) == 0:
        raise SegslamError(f"{file}: none of its {len(poses)} poses belongs to a scan of {run.folder}")
    return Trajectory(scans.scan_index[numbers], scans.stamp_ns[numbers], T_world_lidar[rows])


def _check_length(file: Path, num_poses: int, run: FinishedRun) -> None:
    last = int(run.result.trajectory.scan_index[-1])
    num_read = run.metrics.get("num_scans", 0) + run.metrics.get("num_scans_skipped", 0)
    took_all = run.options.get("frames") == "" and not run.dataset.startswith("kitti/")  # whose numbers may have gaps
    is_other = "sessions" in run.options and num_poses != last + 1  # of a drive, whose numbers are not those of all
    if num_poses <= last or is_other or (took_all and num_poses != num_read):
        raise SegslamError(
            f"{file}: {num_poses} poses, but the run has scans up to number {last}; KITTI format needs one line per "
            "scan, line n + 1 for scan n. TUM format is matched by stamp and may omit scans"
        )


def read_result(log: RunLog) -> SlamResult:
    """The result of a run, but for `alone` and `adjusted`; of a damaged log, odometry and loops of readable steps only.

    Raises SegslamError if the run did not finish.
    """
    estimate, trajectory = log.final()
    T_odom_lidar, keyframe_rows = [], []
    attempts: list[LoopAttempt] = []
    motions: list[Motion] = []
    for row, step in enumerate(log.steps(clouds=False)):
        T_odom_lidar.append(step.T_odom_lidar)
        attempts += step.attempts
        motions += [step.motion] if step.motion else []
        if step.keyframe is not None:
            keyframe_rows.append(row)
    late, num = log.late_loops(), len(T_odom_lidar)
    odometry = Trajectory(trajectory.scan_index[:num], trajectory.stamp_ns[:num], np.array(T_odom_lidar))
    from_map_m = read_localised(log.path.parent, len(trajectory))
    attempts += late
    rows = np.array(keyframe_rows)
    return SlamResult(trajectory, odometry, estimate, rows, tuple(attempts), tuple(motions), len(late), from_map_m)


def read_corrections(log: RunLog, result: SlamResult) -> list[Correction]:
    """The corrections of the points of the keyframes, by the adjustment of the run."""
    adjustment = log.adjustment()
    if adjustment is None or adjustment.sweep is None:
        return [Correction(0.0 if adjustment is None else adjustment.correction_deg)] * len(result.keyframe_rows)
    velocities = velocities_of(result.odometry, result.keyframe_rows, result.motions)
    return corrections_of(adjustment.correction_deg, adjustment.sweep, velocities)
