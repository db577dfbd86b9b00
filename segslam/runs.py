"""A run folder: scans go in one by one, and what a person or a script reads afterwards comes out."""

import csv
import json
import logging
import resource
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from segslam.config import config_to_yaml
from segslam.datasets import Dataset
from segslam.evaluation import loop_metrics, trajectory_metrics
from segslam.log import LogWriter
from segslam.slam import Slam, SlamResult
from segslam.trajectory import Poses, camera_from_lidar, rows_of_same_scan, write_kitti, write_tum
from segslam.types import BadScan, IndexPairs, LoopAttempt, LoopClosure, SegslamError, Step, Trajectory, Transform

logger = logging.getLogger(__name__)

POSE_COLUMNS = tuple(f"T{row}{column}" for row in range(4) for column in range(4))
STAGES = ("prepare", "match", "refine", "verify")


def new_folder(folder: Path) -> Path:
    """An empty folder for a run. Raises SegslamError if there is anything in it, for nothing written is ever lost."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise SegslamError(f"{folder}: not empty; name another folder with --out, or remove it")
    except OSError as error:
        raise SegslamError(f"{folder}: cannot be written to ({error.strerror}); name another with --out") from error
    return folder


class Run:
    """Maps the scans of a data set into a folder."""

    def __init__(
        self,
        folder: Path,
        slam: Slam,
        *,
        dataset: str,
        T_camera_lidar: Transform | None = None,
        reference: Trajectory | None = None,
    ) -> None:
        """`T_camera_lidar`, for KITTI, turns the KITTI-format poses into the camera frame of its ground truth.

        `reference` goes to the log, for whoever scores or repeats the run from its folder.
        """
        self.folder = folder
        self.num_scans_skipped = 0
        self._slam = slam
        self._T_camera_lidar = T_camera_lidar
        self._started = perf_counter()
        self._stage_ms: dict[str, list[float]] = defaultdict(list)
        (folder / "config.yaml").write_text(config_to_yaml(slam.config), encoding="utf-8")
        self._log = LogWriter(
            folder / "log.mcap",
            config=slam.config,
            dataset=dataset,
            T_camera_lidar=T_camera_lidar,
            reference=reference,
        )

    def map(self, dataset: Dataset) -> Iterator[Step | BadScan]:
        """Process and log each scan; a bad one is reported, counted and skipped."""
        for row in range(len(dataset)):
            try:
                started = perf_counter()
                scan = dataset[row]
                self._note_ms("read", perf_counter() - started)
                yield self._logged(self._slam.process(scan))
            except BadScan as error:
                self.num_scans_skipped += 1
                logger.warning("%s; skipped", error)
                yield error

    def repeat(self, steps: Iterator[Step]) -> Iterator[Step]:
        """Do again, from the keyframe on, what a log holds."""
        for recorded in steps:
            yield self._logged(self._slam.repeat(recorded))

    def finish(self) -> tuple[SlamResult, dict[str, Any]]:
        """Optimise once more and write all results; the figures of `metrics.json` that need no reference."""
        started = perf_counter()
        result = self._slam.finish()
        self._note_ms("finish", perf_counter() - started)
        self._log.write_result(result.estimate, result.trajectory)
        self._log.close()
        seconds = perf_counter() - self._started
        write_poses(self.folder, "poses", result.trajectory, self._T_camera_lidar)
        write_poses(self.folder, "odometry", result.odometry, self._T_camera_lidar)
        self._slam.graph.write_g2o(self.folder / "graph.g2o")
        write_loops(self.folder / "loops.csv", result.attempts, result.estimate.closure_weights)
        closures = [attempt for attempt in result.attempts if isinstance(attempt.outcome, LoopClosure)]
        return result, {
            "num_scans": len(result.trajectory),
            "num_scans_skipped": self.num_scans_skipped,
            "num_keyframes": len(result.keyframe_rows),
            "num_candidates": len(result.attempts),
            "num_loops_accepted": len(closures),
            "num_loops_switched_off": sum(weight < 0.5 for weight in result.estimate.closure_weights.values()),
            "seconds_total": seconds,
            "scans_per_second": len(result.trajectory) / seconds,
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "stage_ms": {stage: _median_and_p95(times) for stage, times in self._stage_ms.items()},
        }

    def _logged(self, step: Step) -> Step:
        started = perf_counter()
        self._log.write(step)
        self._note_ms("log", perf_counter() - started)
        for stage, seconds in step.stage_seconds.items():
            self._note_ms(stage, seconds)
        return step

    def _note_ms(self, stage: str, seconds: float) -> None:
        self._stage_ms[stage].append(1000 * seconds)


def accuracy(result: SlamResult, reference: Trajectory) -> dict[str, float]:
    """The figures of `metrics.json` that the true poses give; those of the odometry begin with `odometry_`."""
    corrected = trajectory_accuracy(result.trajectory, reference)
    odometry = trajectory_accuracy(result.odometry, reference)
    return (
        corrected | {f"odometry_{name}": value for name, value in odometry.items()} | _loop_accuracy(result, reference)
    )


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
    """`metrics.json`; a figure that is unknown is left out by the caller."""
    text = json.dumps(metrics, indent=2, allow_nan=False)
    (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")


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


def _median_and_p95(times: list[float]) -> dict[str, float]:
    return {"median": median(times), "p95": float(np.percentile(times, 95))}
