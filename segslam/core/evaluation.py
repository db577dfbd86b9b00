"""Errors of an estimate against ground truth, matched row by row; both are poses of the same body.

Absolute errors are residuals after the best rigid alignment, without scale.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core import geometry
from segslam.core.trajectory import Poses, travelled_m
from segslam.core.types import IndexPairs, Indices, Mask, Points, Transform, Vector

Z_UP = (0.0, 0.0, 1.0)
"""Upward axis of LiDAR frames."""
Up = Literal["z", "-y"]
UP: dict[Up, tuple[float, float, float]] = {"z": Z_UP, "-y": (0.0, -1.0, 0.0)}
"""Upward axes that pose files have, by name; -y in KITTI's camera frames (x right, y down, z ahead)."""
FLAT = 3.0  # chosen: a path is flat if it is this much wider than high; 20 real drives are 5 times at least
ALONG = 0.8  # chosen: smallest component of a direction along its axis; 0.96 or more in these drives
MIN_POSES = 3  # fewer poses are always aligned without error
LINE_TOLERANCE = 1e-6  # smallest extent across a line, relative to that along it; above rounding
LINE_TURN_DEG = 5.0  # chosen: are_deg is omitted if the rotation about the line of positions is less certain than this

SEGMENT_LENGTHS_M = tuple(range(100, 801, 100))
SEGMENT_STEP = 10
"""Number of scans between the starts of KITTI's segments."""

SUCCESS_M, SUCCESS_DEG = 2.0, 5.0
"""Largest errors of a correct registration or loop, as in the Segregator paper."""
REVISIT_M = 4.0
"""A keyframe within this distance of an older one revisits its place (m)."""
REVISIT_MIN_TRAVEL_M = 50.0
FOUND_WITHIN_M = 10.0  # chosen: a closure corrects the drift of revisits within this travel


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """Errors of each row (m, degrees)."""

    translation_m: Vector
    rotation_deg: Vector


def trajectory_metrics(estimate: Poses, reference: Poses, *, up: tuple[float, float, float] = Z_UP) -> dict[str, float]:
    """The error figures of `metrics.json` that can be computed from two trajectories, (n, 4, 4) each.

    ate_m, are_deg, height_m: root mean square errors after alignment; height along `up` in the reference frame.
    rpe_m, rpe_deg: root mean square errors of the motion from each row to the next. kitti_translation_percent,
    kitti_rotation_deg_per_100m: means over KITTI's segments, omitted for drives shorter than 100 m.
    Empty for fewer than 3 rows. height_m is omitted if the positions deviate from a line by no more than the error.
    are_deg is omitted if they deviate by less than 11 times the error: the rotation about the line is then uncertain by
    more than 5 degrees.
    """
    if len(reference) < MIN_POSES:
        return {}
    T_reference_estimate = align_positions(estimate[:, :3, 3], reference[:, :3, 3])
    aligned = T_reference_estimate @ estimate
    absolute = pose_errors(aligned, reference)
    relative = motion_errors(estimate, reference, np.s_[:-1], np.s_[1:])
    ate_m = rms(absolute.translation_m)
    metrics = {"ate_m": ate_m, "rpe_m": rms(relative.translation_m), "rpe_deg": rms(relative.rotation_deg)}
    turn_deg = _turn_about_line_deg(reference[:, :3, 3], ate_m)
    if turn_deg < LINE_TURN_DEG:
        metrics["are_deg"] = rms(absolute.rotation_deg)
    if turn_deg < np.degrees(1.0):
        metrics["height_m"] = rms((aligned - reference)[:, :3, 3] @ np.array(up))
    segments = segment_errors(estimate, reference)
    if len(segments.translation_m):
        metrics["kitti_translation_percent"] = float(100 * segments.translation_m.mean())
        metrics["kitti_rotation_deg_per_100m"] = float(100 * segments.rotation_deg.mean())
    return metrics


def align_positions(source: Points, target: Points) -> Transform:
    """T_target_source that aligns matched points in the least-squares sense (Umeyama, PAMI 1991, with scale 1).

    For points on a line the rotation about it is arbitrary. Raises ValueError for no points or unequal numbers.
    """
    if len(source) == 0 or source.shape != target.shape:
        raise ValueError(f"cannot align {len(source)} points with {len(target)}")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    rotation = geometry.nearest_rotation((target - target_mean).T @ (source - source_mean))  # Eq. (38), (40), (43)
    return geometry.transform(rotation, target_mean - rotation @ source_mean)  # Eq. (41)


def upward_axis(poses: Poses) -> Up | None:
    """The upward axis of the frame of a drive; None if the drive does not show it.

    It is the normal of the plane in which the positions lie. Of a straight drive, the direction of travel shows it:
    cameras look along z, so their y points down. Both hold for vehicles, and for persons who walk on a floor.
    """
    if len(poses) < MIN_POSES:
        return None
    positions = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    _, (_, width, height), axes = np.linalg.svd(positions, full_matrices=False)
    if width > FLAT * height:
        return "z" if abs(axes[2, 2]) > ALONG else "-y" if abs(axes[2, 1]) > ALONG else None
    starts_level = geometry.angle(poses[0]) < math.acos(ALONG)
    motions_m = np.abs((np.linalg.inv(poses[:-1]) @ poses[1:])[:, :3, 3]).sum(axis=0)
    ahead = motions_m / max(motions_m.sum(), np.finfo(float).tiny)
    if not starts_level or ahead.max() < ALONG:
        return None
    return "-y" if ahead[2] == ahead.max() else "z"


def pose_errors(estimate: Poses, reference: Poses) -> PoseErrors:
    """Distance and angle between poses of the same frame, row by row."""
    difference = np.linalg.inv(reference) @ estimate
    angles = ScipyRotation.from_matrix(difference[:, :3, :3]).magnitude() if len(difference) else np.empty(0)
    return PoseErrors(np.linalg.norm(difference[:, :3, 3], axis=1), np.degrees(angles))


def motion_errors(estimate: Poses, reference: Poses, starts: Indices | slice, ends: Indices | slice) -> PoseErrors:
    """Errors of the motions between rows."""
    motions = (np.linalg.inv(poses[starts]) @ poses[ends] for poses in (estimate, reference))
    return pose_errors(*motions)


def segment_errors(estimate: Poses, reference: Poses) -> PoseErrors:
    """KITTI's errors over segments of 100 to 800 m (Geiger et al. 2012); both fields are per metre of the segment.

    A segment starts at every tenth row and ends at the first row that is farther along the true path than its length.
    """
    travel_m = travelled_m(reference)
    starts, lengths = np.meshgrid(np.arange(0, len(reference), SEGMENT_STEP), SEGMENT_LENGTHS_M, indexing="ij")
    ends = np.searchsorted(travel_m, travel_m[starts] + lengths, side="right")
    inside = ends < len(reference)
    starts, ends, lengths = starts[inside], ends[inside], lengths[inside]
    errors = motion_errors(estimate, reference, starts, ends)
    return PoseErrors(errors.translation_m / lengths, errors.rotation_deg / lengths)


def loop_metrics(T_target_source: Poses, rows: IndexPairs, reference: Poses) -> dict[str, float]:
    """Number of false loops among the accepted loops, and share of the revisits with a correct loop.

    `reference`: one row per keyframe, in order of time; `rows`: row of source and target of each closure.
    num_loops_false and loop_precision are omitted without closures. loop_recall, the share of revisiting keyframes with
    a correct closure within 10 m of travel, is omitted without revisits.
    """
    false = false_loops(T_target_source, rows, reference)
    metrics: dict[str, float] = {}
    if len(rows):
        metrics["num_loops_false"] = int(false.sum())
        metrics["loop_precision"] = float(1 - false.mean())
    revisiting = np.flatnonzero(revisits(reference))
    if len(revisiting):
        travel_m = travelled_m(reference)
        closed_m = travel_m[rows[~false, 0]]
        away_m = np.abs(travel_m[revisiting, None] - closed_m[None]).min(axis=1, initial=np.inf)
        metrics["loop_recall"] = float((away_m <= FOUND_WITHIN_M).mean())
    return metrics


def false_loops(T_target_source: Poses, rows: IndexPairs, reference: Poses) -> Mask:
    """True for closures with errors above 2 m or 5 degrees; `rows`: (source, target) of each in `reference`."""
    truth = np.linalg.inv(reference[rows[:, 1]]) @ reference[rows[:, 0]]
    errors = pose_errors(T_target_source, truth)
    return (errors.translation_m > SUCCESS_M) | (errors.rotation_deg > SUCCESS_DEG)


def revisits(reference: Poses) -> Mask:
    """(n,) True for poses within 4 m of an earlier pose at least 50 m of travel before."""
    travel_m = travelled_m(reference)
    near = cKDTree(reference[:, :3, 3]).query_pairs(REVISIT_M, output_type="ndarray")  # older row first
    far_in_travel = travel_m[near[:, 1]] - travel_m[near[:, 0]] >= REVISIT_MIN_TRAVEL_M
    result = np.zeros(len(reference), dtype=bool)
    result[near[far_in_travel, 1]] = True
    return result


def _turn_about_line_deg(positions: Points, error_m: float) -> float:
    """Rotation about the line fitted to the positions that errors of this size can cause (degrees)."""
    along, across, _ = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / np.sqrt(len(positions))
    return float(np.degrees(error_m / across)) if across > LINE_TOLERANCE * along else np.inf


def rms(values: Vector) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
