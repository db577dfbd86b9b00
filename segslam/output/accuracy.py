"""Errors against ground truth: of a run, its odometry and its loops; of a trajectory, as other tools state them."""

from typing import Literal

import numpy as np

from segslam.core import geometry
from segslam.core.evaluation import (
    MIN_POSES,
    Z_UP,
    align_positions,
    loop_metrics,
    motion_errors,
    pose_errors,
    rms,
    trajectory_metrics,
)
from segslam.core.trajectory import Poses, nearest_rows, rows_of_same_scan, travelled_m
from segslam.core.types import IndexPairs, LoopClosure, Points, Trajectory
from segslam.output.folder import ALONE
from segslam.slam.slam import SlamResult

Align = Literal["se3", "sim3", "first", "none"]
"""Alignment of the estimate: rigid (the default everywhere), with scale, by the first pose, or none."""
AFTER: dict[Align, str] = {
    "se3": "after alignment",
    "sim3": "after alignment with scale",
    "first": "after alignment of the first poses",
    "none": "without alignment",
}
"""How an error was measured, in words."""
MOST_OFF = 0.1
"""Largest difference between the length of a pair and the distance asked for, as a share; evo's default."""


def accuracy(result: SlamResult, reference: Trajectory, *, align: Align = "se3") -> dict[str, float]:
    """The figures of `metrics.json` that need ground truth; after another alignment, if it is given.

    Those of the odometry after repairs start with `odometry_`, those of KISS-ICP alone, if known, with `kiss_icp_`. A
    drive localised in a map has no figures of loops, because loops within it are not searched.
    """
    trajectories = {"": result.trajectory, "odometry_": result.odometry, f"{ALONE}_": result.alone}
    figures = {
        prefix + name: value
        for prefix, trajectory in trajectories.items()
        if trajectory is not None
        for name, value in trajectory_accuracy(trajectory, reference, align=align).items()
    }
    if result.from_map_m is not None:
        return figures
    _, *measured = judged_closures(result, reference)
    return figures | loop_metrics(*measured)


def trajectory_accuracy(trajectory: Trajectory, reference: Trajectory, *, align: Align = "se3") -> dict[str, float]:
    """`trajectory_metrics` of the scans that have a true pose, after this alignment."""
    rows = rows_of_same_scan(trajectory.scan_index, reference.scan_index)
    return _metrics(trajectory.T_world_lidar[rows[:, 0]], reference.T_world_lidar[rows[:, 1]], align, Z_UP)


def judged_closures(result: SlamResult, reference: Trajectory) -> tuple[list[LoopClosure], Poses, IndexPairs, Poses]:
    """The closures whose two keyframes have a true pose: they, their poses, the rows of both, and the true poses."""
    rows = rows_of_same_scan(result.trajectory.scan_index[result.keyframe_rows], reference.scan_index)
    place_of_id = {int(keyframe_id): place for place, keyframe_id in enumerate(rows[:, 0])}
    known = [c for c in result.closures() if c.source_id in place_of_id and c.target_id in place_of_id]
    pairs = np.array([(place_of_id[c.source_id], place_of_id[c.target_id]) for c in known], dtype=int).reshape(-1, 2)
    measured = np.array([closure.T_target_source for closure in known]).reshape(-1, 4, 4)
    return known, measured, pairs, reference.T_world_lidar[rows[:, 1]]


def scores(
    estimate: Poses,
    reference: Poses,
    *,
    align: Align = "se3",
    rpe_distance_m: float | None = None,
    up: tuple[float, float, float] = Z_UP,
) -> dict[str, float]:
    """The figures of `trajectory_metrics` after this alignment, and of `words.SCORES`; (n, 4, 4) each, row by row.

    Empty for fewer than 3 rows. `rpe_distance_m` adds the error of the motion between poses this far apart along the
    true path; none is given if the drive is shorter. With `sim3` all figures are of the scaled estimate.
    """
    figures = _metrics(estimate, reference, align, up)
    if not figures:
        return {}
    aligned = aligned_by(estimate, reference, align)
    errors_m = pose_errors(aligned, reference).translation_m
    figures |= {
        "ate_mean_m": float(errors_m.mean()),
        "ate_median_m": float(np.median(errors_m)),
        "ate_max_m": float(errors_m.max()),
    }
    if align == "sim3":
        figures["scale"] = scale_of(estimate[:, :3, 3], reference[:, :3, 3])
    return figures | ({} if rpe_distance_m is None else _over_distance(aligned, reference, rpe_distance_m))


def _metrics(estimate: Poses, reference: Poses, align: Align, up: tuple[float, float, float]) -> dict[str, float]:
    if align == "se3" or len(reference) < MIN_POSES:
        return trajectory_metrics(estimate, reference, up=up)
    aligned = aligned_by(estimate, reference, align)
    figures = trajectory_metrics(aligned, reference, up=up)
    if align in ("first", "none"):  # trajectory_metrics aligns; these are the errors without it
        errors = pose_errors(aligned, reference)
        figures["ate_m"] = rms(errors.translation_m)
        figures["are_deg"] = rms(errors.rotation_deg)
        figures["height_m"] = rms((aligned - reference)[:, :3, 3] @ np.array(up))
    return figures


def aligned_by(estimate: Poses, reference: Poses, align: Align) -> Poses:
    """The estimate in the frame of the reference; (n, 4, 4) each, row by row."""
    if align == "none":
        return estimate
    if align == "first":
        return reference[0] @ geometry.inverse(estimate[0]) @ estimate
    if align == "sim3":
        estimate = estimate.copy()
        estimate[:, :3, 3] *= scale_of(estimate[:, :3, 3], reference[:, :3, 3])
    return align_positions(estimate[:, :3, 3], reference[:, :3, 3]) @ estimate


def scale_of(source: Points, target: Points) -> float:
    """The factor of the source that aligns matched points best (Umeyama, PAMI 1991, Eq. 42); 1 if all are one point."""
    source_centred, target_centred = source - source.mean(axis=0), target - target.mean(axis=0)
    spread = float(np.square(source_centred).sum())
    rotation = align_positions(source, target)[:3, :3]
    return float((target_centred * (source_centred @ rotation.T)).sum() / spread) if spread > 0 else 1.0


def pairs_at_distance(reference: Poses, distance_m: float) -> IndexPairs:
    """Rows (i, j) of all poses and the later pose nearest to this distance along the path, if within 10 % of it."""
    travel_m = travelled_m(reference)
    wanted = travel_m + distance_m
    nearer = nearest_rows(travel_m, wanted)
    rows = np.arange(len(travel_m))
    close = np.abs(travel_m[nearer] - wanted) <= MOST_OFF * distance_m
    return np.column_stack([rows, nearer])[close & (nearer > rows)]


def _over_distance(estimate: Poses, reference: Poses, distance_m: float) -> dict[str, float]:
    pairs = pairs_at_distance(reference, distance_m)
    if len(pairs) == 0:
        return {}
    errors_m = motion_errors(estimate, reference, *pairs.T).translation_m
    return {
        "rpe_distance_m": distance_m,
        "rpe_over_distance_m": rms(errors_m),
        "rpe_over_distance_percent": float(100 * errors_m.mean() / distance_m),
    }
