"""The result of a run, its export to files and plain values, its errors, and a plot."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from segslam.core.evaluation import align_positions, trajectory_metrics
from segslam.core.pose_files import write_kitti, write_tum
from segslam.core.trajectory import Poses, as_poses, begun_among, camera_from_lidar, parted, rows_of_same_scan
from segslam.core.types import (
    GraphEstimate,
    Indices,
    Information,
    LoopAttempt,
    LoopClosure,
    Mask,
    Motion,
    MotionState,
    Record,
    Rejected,
    SegslamError,
    Trajectory,
    Transform,
    Vector,
    probability_text,
)
from segslam.core.whole_files import check_target, expanded
from segslam.odometry.motion_model import information_of
from segslam.slam.adjustment.rounds import Adjusted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRUSTED_M = 20.0
"""Chosen: a scan is localised if a keyframe placed in the map is this near in travel; odometry drifts by 1 or 2 %."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SlamResult(Record):
    """Result of a run: the pose of every scan before and after loop closing, keyframes, loop attempts, motions."""

    trajectory: Trajectory
    odometry: Trajectory
    estimate: GraphEstimate
    keyframe_rows: Indices
    """Row of each keyframe, by id, in the two trajectories."""
    attempts: tuple[LoopAttempt, ...]
    """The last attempt for each pair of keyframes: a loop that waited for confirmation was tried before."""
    motions: tuple[Motion, ...] = ()
    """Check of each scan's motion, one per row of the trajectories; empty for logs of older versions."""
    num_late_attempts: int = 0
    """Number of attempts made after the last scan; they are the last ones."""
    from_map_m: Vector | None = None
    """For a drive localised in an existing map: travel from each scan to the nearest keyframe placed in the map,
    infinite across a break. None without such a map."""
    alone: Trajectory | None = None
    """The poses by KISS-ICP alone, without repairs by the check; None if they are unknown."""
    adjusted: Adjusted | None = None
    """The adjustment of the whole map, which led to `estimate`; None if there was none, or if the run was read from
    files."""

    def __post_init__(self) -> None:
        """Keep the last attempt for each pair."""
        last = {one.candidate.pair: row for row, one in enumerate(self.attempts)}
        rows = sorted(last.values())
        first_late = len(self.attempts) - self.num_late_attempts
        object.__setattr__(self, "num_late_attempts", sum(row >= first_late for row in rows))
        object.__setattr__(self, "attempts", tuple(self.attempts[row] for row in rows))

    def localised(self) -> Mask:
        """(n,) True for scans near enough to a keyframe placed in the map; True for all scans without such a map."""
        if self.from_map_m is None:
            return np.ones(len(self.trajectory), dtype=bool)
        return self.from_map_m <= TRUSTED_M

    @property
    def begun(self) -> Indices:
        """Rows of the scans with which another drive of a merged run begins."""
        return np.array([row for row, one in enumerate(self.motions) if one.state is MotionState.BEGUN], np.int64)

    def keyframe_informations(self) -> list[Information | None]:
        """Information of the motion from the previous keyframe to each; None for the noise model of odometry.

        None for all if the log has no motions.
        """
        if len(self.motions) != len(self.trajectory):
            return [None] * len(self.keyframe_rows)
        firsts = [0, *(self.keyframe_rows[:-1] + 1).tolist()]
        rows = zip(firsts, self.keyframe_rows.tolist(), strict=True)
        return [information_of(self.motions[first : row + 1]) for first, row in rows]

    def to_tum(self, path: str | Path) -> None:
        """Write the corrected LiDAR poses of all scans in TUM format: seconds x y z qx qy qz qw."""
        file = expanded(path)
        check_target(file)
        write_tum(file, self.trajectory.stamp_ns, self.trajectory.T_world_lidar)

    def to_kitti(self, path: str | Path, *, T_camera_lidar: Transform | None = None) -> None:
        """Write the corrected poses in KITTI format, 12 numbers per line; camera poses if a calibration is given."""
        file, poses = expanded(path), self.trajectory.T_world_lidar
        check_target(file)
        write_kitti(file, poses if T_camera_lidar is None else camera_from_lidar(poses, T_camera_lidar))

    def errors(self, reference: Trajectory | Poses) -> dict[str, float]:
        """Errors against ground-truth LiDAR poses in any frame: `ate_m` and the other figures of `metrics.json`.

        A `Trajectory` is matched by scan number; an array (n, 4, 4) has one pose per scan. Raises SegslamError for
        another number of poses, or if fewer than 3 scans have a ground-truth pose.
        """
        rows, truth = self._matched(reference)
        poses = self.trajectory.T_world_lidar[rows]
        figures = trajectory_metrics(poses, truth)
        if not figures:
            raise SegslamError(f"{len(poses)} scans have a true pose; at least three are needed")
        return figures

    def plot(self, reference: Trajectory | Poses | None = None) -> "Figure":
        """matplotlib figure with a top view of odometry, corrected trajectory, loops and reference."""
        from matplotlib.figure import Figure

        T_show_world = np.eye(4)
        figure = Figure(figsize=(7, 6), layout="constrained")
        axes = figure.subplots()
        if reference is not None:
            rows, truth = self._matched(reference)
            T_show_world = align_positions(self.trajectory.T_world_lidar[rows, :3, 3], truth[:, :3, 3])
            drawn = parted(truth[:, :2, 3], begun_among(rows, self.begun))
            axes.plot(*drawn.T, color="#B8B8B8", linewidth=4, label="reference")
        corrected, odometry = (
            (T_show_world @ drive.T_world_lidar)[:, :2, 3] for drive in (self.trajectory, self.odometry)
        )
        axes.plot(*parted(odometry, self.begun).T, "--", color="#E69F00", linewidth=1.4, label="odometry")
        axes.plot(*parted(corrected, self.begun).T, color="#0072B2", linewidth=1.4, label="corrected")
        closures = self.closures()
        for closure in closures:
            ends = corrected[self.keyframe_rows[[closure.source_id, closure.target_id]]]
            axes.plot(*ends.T, "o-", color="#009E73", markersize=3)
        axes.plot([], [], "o-", color="#009E73", markersize=3, label=f"loops ({len(closures)})")
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", adjustable="datalim")
        axes.legend()
        return figure

    def closures(self) -> list[LoopClosure]:
        """The accepted loops."""
        return [attempt.outcome for attempt in self.attempts if isinstance(attempt.outcome, LoopClosure)]

    def to_dict(self) -> dict[str, Any]:
        """The result as lists and numbers for JSON: poses of all scans as 4 x 4 rows, keyframes, accepted loops."""
        return {
            "scan_index": self.trajectory.scan_index.tolist(),
            "stamp_ns": self.trajectory.stamp_ns.tolist(),
            "T_world_lidar": self.trajectory.T_world_lidar.tolist(),
            "T_odom_lidar": self.odometry.T_world_lidar.tolist(),
            "keyframe_rows": self.keyframe_rows.tolist(),
            "num_candidates": len(self.attempts),
            "loops": [
                {
                    "source": closure.source_id,
                    "target": closure.target_id,
                    "T_target_source": closure.T_target_source.tolist(),
                    "weight": self.estimate.closure_weights.get(closure.pair),
                }
                for closure in self.closures()
            ],
        }

    def _matched(self, reference: Trajectory | Poses) -> tuple[Indices, Poses]:
        """Rows of the scans that have ground truth, and their true poses."""
        own = self.trajectory
        if isinstance(reference, Trajectory):
            rows = rows_of_same_scan(own.scan_index, reference.scan_index)
            return rows[:, 0], reference.T_world_lidar[rows[:, 1]]
        truth = as_poses(reference, "reference")
        if len(truth) != len(own):
            raise SegslamError(f"reference: {len(truth)} poses for {len(own)} scans; give one for each, (n, 4, 4)")
        return np.arange(len(own)), truth


def outcome_text(attempt: LoopAttempt, closure_weights: Mapping[tuple[int, int], float]) -> str:
    """The outcome of a loop candidate in one line; the weights are those of the last estimate."""
    outcome = attempt.outcome
    if isinstance(outcome, Rejected):
        reason = outcome.reason.value.replace("_", " ")
        return f"rejected, {reason}" + (f" ({outcome.detail})" if outcome.detail else "")
    weight = closure_weights[outcome.pair]
    found = outcome.alignment
    probable = "" if found.probability is None else f"{probability_text(found.probability, found.evidence)}, "
    return f"accepted, {probable}overlap {found.overlap:.2f}, residual {found.rms_m:.2f} m, weight {weight:.2f}"
