"""Errors of a run against ground truth: trajectory, odometry, loops."""

import numpy as np

from segslam.core.evaluation import loop_metrics, trajectory_metrics
from segslam.core.trajectory import Poses, rows_of_same_scan
from segslam.core.types import IndexPairs, LoopClosure, Trajectory
from segslam.output.folder import ALONE
from segslam.slam.slam import SlamResult


def accuracy(result: SlamResult, reference: Trajectory) -> dict[str, float]:
    """The figures of `metrics.json` that need ground truth.

    Those of the odometry after repairs start with `odometry_`, those of KISS-ICP alone, if known, with `kiss_icp_`. A
    drive localised in a map has no figures of loops, because loops within it are not searched.
    """
    corrected = trajectory_accuracy(result.trajectory, reference)
    others = {"odometry_": result.odometry} | ({} if result.alone is None else {f"{ALONE}_": result.alone})
    compared = {
        prefix + name: value
        for prefix, trajectory in others.items()
        for name, value in trajectory_accuracy(trajectory, reference).items()
    }
    loops = {} if result.from_map_m is not None else _loop_accuracy(result, reference)
    return corrected | compared | loops


def trajectory_accuracy(trajectory: Trajectory, reference: Trajectory) -> dict[str, float]:
    """`trajectory_metrics` of the scans that have a true pose."""
    rows = rows_of_same_scan(trajectory.scan_index, reference.scan_index)
    return trajectory_metrics(trajectory.T_world_lidar[rows[:, 0]], reference.T_world_lidar[rows[:, 1]])


def judged_closures(result: SlamResult, reference: Trajectory) -> tuple[list[LoopClosure], IndexPairs, Poses]:
    """The closures whose two keyframes have a true pose, the rows of (source, target), and the true poses, by row."""
    rows = rows_of_same_scan(result.trajectory.scan_index[result.keyframe_rows], reference.scan_index)
    place_of_id = {int(keyframe_id): place for place, keyframe_id in enumerate(rows[:, 0])}
    closures = [attempt.outcome for attempt in result.attempts if isinstance(attempt.outcome, LoopClosure)]
    known = [c for c in closures if c.source_id in place_of_id and c.target_id in place_of_id]
    pairs = np.array([(place_of_id[c.source_id], place_of_id[c.target_id]) for c in known], dtype=int).reshape(-1, 2)
    return known, pairs, reference.T_world_lidar[rows[:, 1]]


def _loop_accuracy(result: SlamResult, reference: Trajectory) -> dict[str, float]:
    closures, pairs, truth = judged_closures(result, reference)
    return loop_metrics(np.array([c.T_target_source for c in closures]).reshape(-1, 4, 4), pairs, truth)
