"""Errors of runs, trajectories and pose files against ground truth."""

from pathlib import Path
from typing import get_args

import numpy as np

from segslam.core.evaluation import Z_UP
from segslam.core.pose_files import PoseFile, read_poses
from segslam.core.trajectory import Poses, as_poses, rows_of_same_scan, rows_of_same_stamp
from segslam.core.types import SegslamError, Trajectory
from segslam.core.whole_files import expanded
from segslam.output.accuracy import Align, scores
from segslam.output.finished import STAMP_TOLERANCE_NS, FinishedRun, read_run, true_poses
from segslam.output.folder import folder_of

Given = FinishedRun | Trajectory | Poses | str | Path
"""A run, its folder or log, a trajectory, poses (n, 4, 4), or a pose file in KITTI or TUM format."""


def evaluate(
    estimate: Given,
    reference: Given | None = None,
    *,
    align: Align = "se3",
    rpe_distance_m: float | None = None,
    up: tuple[float, float, float] = Z_UP,
) -> dict[str, float]:
    """The error figures of `segslam eval`: `ate_m` (rms, m), its mean, median and maximum, KITTI's errors and others.

    Poses of runs and trajectories are matched by scan number, those of TUM files by stamp (within 10 ms), all others
    row by row. A file as reference of a run is read as `segslam eval` does: in KITTI format line n + 1 is scan n, and
    its poses are those of the camera for KITTI's data. `reference` may be omitted for a run with ground truth. `align`,
    `rpe_distance_m` as for `--align` and `--rpe-distance`; `up`: upward axis of the reference. Raises SegslamError if
    fewer than three poses match.
    """
    if align not in get_args(Align):
        raise SegslamError(f"evaluate: align={align!r}: unknown; known: {', '.join(get_args(Align))}")
    if rpe_distance_m is not None and not rpe_distance_m > 0.0:
        raise SegslamError(f"evaluate: rpe_distance_m={rpe_distance_m}; give a distance above 0")
    if np.shape(up) != (3,) or not 0.0 < np.linalg.norm(up) < np.inf:
        raise SegslamError(f"evaluate: up={up}; give the direction of the upward axis, such as (0, 0, 1)")
    made, run = _read(estimate)
    if reference is None:
        reference = run.reference if run else None
        if reference is None:
            raise SegslamError("evaluate: no ground truth; give `reference`")
    matched, truth = matched_poses(made, _read(reference, run)[0])
    x, y, z = (np.asarray(up) / np.linalg.norm(up)).tolist()
    figures = scores(matched, truth, align=align, rpe_distance_m=rpe_distance_m, up=(x, y, z))
    if not figures:
        raise SegslamError(f"evaluate: only {len(matched)} poses match the reference; at least three are needed")
    return figures


def _read(given: Given, of: FinishedRun | None = None) -> tuple[Trajectory | PoseFile, FinishedRun | None]:
    """The poses, and the run that has them, if one does; a file is the reference `of` a run, if there is one."""
    if isinstance(given, str | Path):
        path = expanded(given)
        if not folder_of(path).is_dir():
            return true_poses(path, of) if of else read_poses(path), None
        given = read_run(path)
    if isinstance(given, FinishedRun):
        return given.result.trajectory, given
    return given if isinstance(given, Trajectory) else PoseFile(as_poses(given, "evaluate"), None), None


def matched_poses(
    made: Trajectory | PoseFile, true: Trajectory | PoseFile, *, max_difference_ns: int = STAMP_TOLERANCE_NS
) -> tuple[Poses, Poses]:
    """Poses of the same scan or time, else row by row. Raises SegslamError for unequal numbers of rows."""
    T_made, T_true = (known.T_world_lidar if isinstance(known, Trajectory) else known.T_a_b for known in (made, true))
    if isinstance(made, Trajectory) and isinstance(true, Trajectory):
        rows = rows_of_same_scan(made.scan_index, true.scan_index)
    elif made.stamp_ns is not None and true.stamp_ns is not None:
        rows = rows_of_same_stamp(made.stamp_ns, true.stamp_ns, max_difference_ns=max_difference_ns)
    elif len(made) == len(true):
        return T_made, T_true
    else:
        raise SegslamError(f"evaluate: {len(made)} poses for {len(true)} true ones; without stamps give one for each")
    return T_made[rows[:, 0]], T_true[rows[:, 1]]
