"""A run folder: scans go in one by one, and what a person or a script reads afterwards comes out."""

import logging
import resource
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np

from segslam.beside import beside
from segslam.config import config_to_yaml
from segslam.datasets import Dataset
from segslam.evaluation import loop_metrics, trajectory_metrics
from segslam.log import LogWriter, RunLog
from segslam.run_files import LOG, UNFINISHED, room_for, write_loops, write_poses
from segslam.slam import Slam, SlamResult, Tracked
from segslam.trajectory import Poses, rows_of_same_scan
from segslam.types import (
    AngleSamples,
    BadScan,
    IndexPairs,
    LoopClosure,
    Scan,
    SegslamError,
    Step,
    Trajectory,
    Transform,
)

logger = logging.getLogger(__name__)

MOST_WAITING = 8
"""Chosen: scans that odometry may be ahead of the loops, some 2 MB each; a keyframe with two loops takes as long."""


class Run:
    """Maps the scans of a data set into a folder; a context manager."""

    def __init__(
        self,
        folder: Path,
        slam: Slam,
        *,
        dataset: str,
        T_camera_lidar: Transform | None = None,
        reference: Trajectory | None = None,
        options: Mapping[str, str] = MappingProxyType({}),
        resumes: bool = False,
    ) -> None:
        """`T_camera_lidar`, for KITTI, turns the KITTI-format poses into the camera frame of its ground truth.

        `reference` goes to the log, for whoever scores or repeats the run from its folder; `options` too, for whoever
        resumes it. A run that `resumes` has a log in its folder, which stays until `resume` has taken it over.
        """
        self.folder = folder
        self.num_scans_skipped = 0
        self.num_scans_resumed = 0
        self._next_row = 0
        self._slam = slam
        self._T_camera_lidar = T_camera_lidar
        self._started = perf_counter()
        self._stage_ms: dict[str, list[float]] = defaultdict(list)
        with room_for(folder):
            (folder / "config.yaml").write_text(config_to_yaml(slam.config), encoding="utf-8")
        self._log = LogWriter(
            folder / (LOG + UNFINISHED if resumes else LOG),
            config=slam.config,
            dataset=dataset,
            T_camera_lidar=T_camera_lidar,
            reference=reference,
            options=options,
        )
        slam.keep_clouds_in(self._log)

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *_: object) -> None:
        """Close the log, also that of a run that failed; a log not yet moved to its place goes."""
        self._log.close()
        (self.folder / (LOG + UNFINISHED)).unlink(missing_ok=True)

    def resume(self, recorded: RunLog, dataset: Dataset) -> Iterator[Step]:
        """Do again, from the keyframe on, what the folder's log holds; `map` goes on after it.

        The steps go to a new log, which takes the old one's place when it has them all: a kill loses none of them.
        Raises SegslamError if they are not of this data set.
        """
        row_of_scan = {int(index): row for row, index in enumerate(dataset.scan_index)}
        taken: list[tuple[int, int]] = []
        for step in recorded.steps():
            if step.scan_index not in row_of_scan:
                raise _other_data(recorded.path, f"has scan {step.scan_index}, the data given has not")
            taken.append((row_of_scan[step.scan_index], step.stamp_ns))
            yield self._logged(replace(self._slam.repeat(step), stage_seconds=step.stage_seconds))

        def scan_of(number: int) -> Scan:
            row, stamp_ns = taken[number]
            scan = dataset[row]
            if scan.stamp_ns != stamp_ns:
                raise _other_data(recorded.path, f"has scan {scan.index} at {stamp_ns} ns, the data {scan.stamp_ns} ns")
            return scan

        self._slam.go_on(scan_of)
        self._log.move(recorded.path)
        self.num_scans_resumed = len(taken)
        self._next_row = taken[-1][0] + 1 if taken else 0
        self.num_scans_skipped = self._next_row - len(taken)

    def map(self, dataset: Dataset) -> Iterator[Step | BadScan]:
        """Process and log each scan after those resumed; a bad one is reported, counted and skipped.

        Scans are read here, tracked in a thread beside, and in another loops are closed and steps logged.
        """
        tracked = beside(self._read(dataset), self._track, most_waiting=1)
        return beside(tracked, self._done, most_waiting=MOST_WAITING)

    def repeat(self, steps: Iterator[Step]) -> Iterator[Step]:
        """Do again, from the keyframe on, what a log holds; it is read here, while the rest is done beside."""
        return beside(steps, lambda recorded: self._logged(self._slam.repeat(recorded)), most_waiting=MOST_WAITING)

    def finish(self, angles: AngleSamples | None = None) -> tuple[SlamResult, dict[str, Any]]:
        """Optimise once more and write all results; the figures of `metrics.json` that need no reference.

        `angles` as in `Slam.finish`.
        """
        started = perf_counter()
        result = self._slam.finish(angles)
        self._note_ms("finish", perf_counter() - started)
        self._log.write_result(result.estimate, result.trajectory, result.angles)
        self._log.close()
        seconds = perf_counter() - self._started
        with room_for(self.folder):
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
            "scans_per_second": (len(result.trajectory) - self.num_scans_resumed) / seconds,
            "peak_rss_mb": peak_rss_mb(),
            "systematic_drift": None if result.drift is None else asdict(result.drift),
            "stage_ms": {stage: _median_and_p95(times) for stage, times in self._stage_ms.items()},
        }

    def _read(self, dataset: Dataset) -> Iterator[Scan | BadScan]:
        for row in range(self._next_row, len(dataset)):
            started = perf_counter()
            try:
                scan: Scan | BadScan = dataset[row]
            except BadScan as error:
                scan = error
            self._note_ms("read", perf_counter() - started)
            yield scan

    def _track(self, scan: Scan | BadScan) -> Tracked | BadScan:
        try:
            return scan if isinstance(scan, BadScan) else self._slam.track(scan)
        except BadScan as error:
            return error

    def _done(self, tracked: Tracked | BadScan) -> Step | BadScan:
        if isinstance(tracked, BadScan):
            self.num_scans_skipped += 1
            logger.warning("%s; skipped", tracked)
            return tracked
        return self._logged(self._slam.close_loops(tracked))

    def _logged(self, step: Step) -> Step:
        started = perf_counter()
        self._log.write(step)
        self._note_ms("log", perf_counter() - started)
        for stage, seconds in step.stage_seconds.items():
            self._note_ms(stage, seconds)
        return step

    def _note_ms(self, stage: str, seconds: float) -> None:
        self._stage_ms[stage].append(1000 * seconds)


def peak_rss_mb() -> float:
    """Most memory that this process has had so far, and that of the odometry's own, which has ended."""
    processes = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(resource.getrusage(process).ru_maxrss for process in processes) / 1024


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


def _other_data(log: Path, difference: str) -> SegslamError:
    return SegslamError(f"{log}: {difference}; resume with the data that the run began with")


def _median_and_p95(times: list[float]) -> dict[str, float]:
    return {"median": median(times), "p95": float(np.percentile(times, 95))}
