"""A run: processes the scans of a data set, and writes the files of the run folder."""

import logging
import math
import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path
from statistics import median
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np

from segslam.core.config import config_to_yaml
from segslam.core.errors import LateScan
from segslam.core.memory import give_back, peak_mb
from segslam.core.processes import Progress, no_progress
from segslam.core.threads import in_other_thread
from segslam.core.trajectory import travelled_m
from segslam.core.types import BadScan, CloudOf, MotionState, Scan, SegslamError, Step, Trajectory, Transform
from segslam.core.whole_files import settle, write_whole
from segslam.graph import PoseGraph
from segslam.output.accuracy import accuracy
from segslam.output.finished import parts_in, read_metrics
from segslam.output.folder import (
    ADJUSTED_GRAPH,
    ALONE,
    ALONE_FILES,
    LOG,
    PLACE_FILES,
    UNFINISHED,
    read_alone,
    room_for,
    write_localised,
    write_loops,
    write_metrics,
    write_poses,
)
from segslam.output.log import LogWriter, Mirror, RunLog, read_log
from segslam.run.sessions.recorded import figures_of
from segslam.scans import Dataset
from segslam.slam.adjustment.vertical_angle import measure_vertical_angle
from segslam.slam.slam import Slam, SlamResult, Tracked

logger = logging.getLogger(__name__)

MOST_WAITING = 8
"""Chosen: scans by which odometry may lead loop closing, about 2 MB each: the time of a keyframe with two loops."""

TRIM_EVERY = 100
"""Chosen: scans between two times that freed memory is returned to the system, each of which takes 10 ms."""


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
        mirror: Mirror | None = None,
    ) -> None:
        """`T_camera_lidar`, for KITTI, transforms the KITTI-format poses into the camera frame of its ground truth.

        `reference` and `options` are written to the log, for later scoring, replaying and resuming. With `resumes`, the
        existing log in the folder remains until `resume` has replaced it. Otherwise the folder is removed if the run
        ends without a step. `mirror` is called with each message of the log.
        """
        self.folder = folder
        self.num_steps = 0
        self.config = slam.config
        self.num_scans_skipped = self._num_scans_late = 0
        self.num_scans_resumed = 0
        self._dataset = dataset
        self._reference = reference
        self._resumes = resumes
        self._next_row = 0
        self._unreported: list[BadScan] = []
        """Bad scans before the first step; if no step follows, one error reports them."""
        self._slam = slam
        self._T_camera_lidar = T_camera_lidar
        self._started = self._started_mapping = perf_counter()
        self._stage_ms: dict[str, list[float]] = defaultdict(list)
        try:
            self._sessions = parts_in(options.get("sessions", ""))
            self._log = LogWriter(
                folder / (LOG + UNFINISHED if resumes else LOG),
                config=slam.config,
                dataset=dataset,
                T_camera_lidar=T_camera_lidar,
                reference=reference,
                options=options,
                mirror=mirror,
                replaces=resumes,
            )
            write_whole(folder / "config.yaml", config_to_yaml(slam.config))
        except FileExistsError as error:
            raise SegslamError(f"{folder}: another run has begun there; give another folder") from error
        except BaseException:
            self._remove_unbegun()
            raise
        slam.keep_clouds_in(self._log)

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *_: object) -> None:
        """Close the log, also after a failure; a log that does not yet replace the old one is removed."""
        try:
            self._log.close()
        finally:
            if self._resumes:
                (self.folder / (LOG + UNFINISHED)).unlink(missing_ok=True)
            self._remove_unbegun()

    def _remove_unbegun(self) -> None:
        """Remove the files of a run without a step, so that the folder can be used again."""
        if self.num_steps == 0 and not self._resumes:
            for name in ("config.yaml", LOG):
                (self.folder / name).unlink(missing_ok=True)
            with suppress(OSError):  # what else is there stays
                self.folder.rmdir()

    def resume(self, recorded: RunLog, dataset: Dataset) -> Iterator[Step]:
        """Repeat the logged steps, starting from the keyframes; `map` then continues with the following scans.

        The steps are written to a new log, which replaces the old one when it is complete, so that a kill loses no
        step. Raises SegslamError if the log belongs to another data set.
        """
        row_of_scan = {int(index): row for row, index in enumerate(dataset.scan_index)}
        taken: list[tuple[int, int]] = []
        for step in recorded.steps():
            if step.scan_index not in row_of_scan:
                raise _other_data(recorded.path, f"contains scan {step.scan_index}, which the given data does not")
            taken.append((row_of_scan[step.scan_index], step.stamp_ns))
            yield self._logged(replace(self._slam.repeat(step), stage_seconds=step.stage_seconds))

        def scan_of(number: int) -> Scan:
            row, stamp_ns = taken[number]
            try:
                scan = dataset[row]
            except BadScan as error:
                raise SegslamError(
                    f"{error}; {recorded.path} has it mapped, so restore it to resume, or: segslam replay "
                    f"{shlex.quote(str(recorded.path.parent))} --out NEW"
                ) from error
            if scan.stamp_ns != stamp_ns:
                raise _other_data(recorded.path, f"has scan {scan.index} at {stamp_ns} ns, the data {scan.stamp_ns} ns")
            return scan

        self._slam.resume(scan_of)
        self._log.move(recorded.path)
        # the state of KISS-ICP is lost; place and report, which completes a run, are of fewer scans
        for name in (*ALONE_FILES, *PLACE_FILES, "report.html"):
            (self.folder / name).unlink(missing_ok=True)
        self.num_scans_resumed = len(taken)
        self._started_mapping = perf_counter()
        self._next_row = taken[-1][0] + 1 if taken else 0
        self.num_scans_skipped = self._next_row - len(taken)

    def map(self, dataset: Dataset) -> Iterator[Step | BadScan]:
        """Process and log each scan after those resumed, in three threads; a bad scan is reported and counted."""
        tracked = in_other_thread(self._read(dataset), self._track, max_waiting=1)
        return in_other_thread(tracked, self.follow, max_waiting=MOST_WAITING)

    def follow(self, tracked: Tracked | BadScan, *, tries_loops: bool = True) -> Step | BadScan:
        """Close loops for a tracked scan, and log the step; a bad scan is reported and counted."""
        if isinstance(tracked, BadScan):
            self.num_scans_skipped += 1
            self._num_scans_late += isinstance(tracked, LateScan)
            self._report(tracked)
            return tracked
        return self._logged(self._slam.close_loops(tracked, tries_loops=tries_loops))

    def map_so_far(self) -> tuple[dict[int, Transform], CloudOf]:
        """The current pose of each keyframe, and a function that reads its points, which is safe in other threads."""
        return dict(enumerate(self._slam.graph.T_world_keyframes.copy())), self._log.cloud

    def repeat(self, steps: Iterator[Step]) -> Generator[Step, None, None]:
        """Repeat the steps of a log, starting from the keyframes; this thread reads the log, another works."""
        return in_other_thread(steps, lambda step: self._logged(self._slam.repeat(step)), max_waiting=MOST_WAITING)

    def take(self, steps: Iterator[tuple[Step, int, bool]]) -> Iterator[Step]:
        """Take over recorded steps with their loops: each item is a Step, and `below` and `optimize` of `Slam.take`."""
        return in_other_thread(steps, lambda item: self._logged(self._slam.take(*item)), max_waiting=MOST_WAITING)

    def _finish(self, search_s: float, progress: Progress) -> tuple[SlamResult, dict[str, Any]]:
        """Final optimisation; writes all results. Returns the result and the figures that need no reference."""
        if self.num_steps == 0:
            why = "no scan was mapped"
            if self._unreported:
                why = f"none of {len(self._unreported)} scans could be used; the first: {self._unreported[0]}"
            raise SegslamError(f"{self._dataset}: {why}")
        with self._timed("finish"):
            result = self._slam.finish(search_s=search_s, progress=progress)
        if result.adjusted is None:
            with self._timed("calibrate"):
                figures = self._vertical_angle(result)
        else:
            figures = result.adjusted.record.figures()
            self._note_ms("adjust", result.adjusted.record.seconds)
        if result.alone is None:
            result = replace(result, alone=read_alone(self.folder, result.odometry))  # a replay has a copy
        self._write(result)
        seconds, seconds_mapping = (perf_counter() - since for since in (self._started, self._started_mapping))
        states = Counter(motion.state for motion in result.motions)
        return result, {
            "num_scans": len(result.trajectory),
            "num_scans_skipped": self.num_scans_skipped,
            "num_scans_late": self._num_scans_late,
            "length_m": float(travelled_m(result.trajectory.T_world_lidar)[-1]),
            "duration_s": float(np.ptp(result.trajectory.stamp_ns)) / 1e9,
            "num_keyframes": len(result.keyframe_rows),
            "num_motions_repaired": states[MotionState.REPAIRED] + states[MotionState.REJOINED],
            "num_motions_broken": states[MotionState.BROKEN],
            "num_motions_rejected": len(result.estimate.motion_weights),
            "num_candidates": len(result.attempts),
            "num_loops_accepted": len(result.closures()),
            "num_loops_switched_off": len(result.estimate.rejected),
            "seconds_total": seconds,
            "scans_per_second": (len(result.trajectory) - self.num_scans_resumed) / seconds_mapping,
            "peak_rss_mb": peak_mb(),
            **figures,
            **({} if result.from_map_m is None else {"localised_percent": 100.0 * float(result.localised().mean())}),
            "stage_ms": {
                stage: {"median": median(times), "p95": float(np.percentile(times, 95))}
                for stage, times in self._stage_ms.items()
            },
        }

    def _write(self, result: SlamResult) -> None:
        """End the log, and write the files of poses, graph and loops."""
        late = result.attempts[len(result.attempts) - result.num_late_attempts :]
        self._log.write_result(result.estimate, result.trajectory, late, result.adjusted)
        self._log.end()  # the run is in progress until all its files are written
        with room_for(self.folder):
            write_poses(self.folder, "poses", result.trajectory, self._T_camera_lidar, among=result.localised())
            if result.from_map_m is not None:
                write_localised(self.folder, result.trajectory, result.from_map_m, result.localised())
            write_poses(self.folder, "odometry", result.odometry, self._T_camera_lidar)
            if result.alone is not None:
                write_poses(self.folder, ALONE, result.alone, self._T_camera_lidar)
            self._slam.graph.write_g2o(self.folder / "graph.g2o")
            if isinstance(self._slam.graph, PoseGraph):
                self._slam.graph.write_adjusted_g2o(self.folder / ADJUSTED_GRAPH)
            write_loops(self.folder / "loops.csv", result.attempts, result.estimate.closure_weights)

    def complete(
        self,
        *,
        more: Callable[[SlamResult], Mapping[str, Any]] = lambda _: {},
        place: Callable[[Path], str] | None = None,
        map_files: Sequence[Path] = (),
        search_s: float = math.inf,
        progress: Progress = no_progress,
    ) -> tuple[dict[str, Any], str]:
        """Finish the run, and write the rest of its folder; returns `metrics.json`, and what `place` returned.

        `more` adds figures computed from the result; `place` georeferences the folder before the maps are written;
        `search_s` and `progress` as in `Slam.finish`. No map is written of a drive that was not localised anywhere.
        Raises SegslamError without a step. A failure of place or maps leaves a report, and one of the place the maps.
        """
        from segslam.output.report import write_report

        result, metrics = self._finish(search_s, progress)
        if self._reference is not None:
            metrics |= accuracy(result, self._reference)
        if self._sessions:
            metrics |= figures_of(self._sessions, result)
        metrics |= more(result)
        write_metrics(self.folder, metrics)
        placed, failure = "", None
        try:
            if place is not None:
                try:
                    placed = place(self.folder)
                    metrics = read_metrics(self.folder)
                except SegslamError as error:  # the maps do not need it
                    failure = error
            if map_files and result.localised().any():
                from segslam.output.export import write_maps

                log = read_log(self.folder)
                metrics |= write_maps(log, map_files, config=log.config.map, show=progress)
                metrics["peak_rss_mb"] = peak_mb()
                write_metrics(self.folder, metrics)
        except SegslamError as error:
            failure = failure or error
        finally:
            with room_for(self.folder):
                write_report(self.folder)
        if failure is not None:
            raise failure
        return metrics, placed

    def _vertical_angle(self, result: SlamResult) -> dict[str, float]:
        """The remaining vertical angle of the scans as figures; empty if too few scans show it."""
        known = self._slam.known
        found = (
            known.angle
            if known
            else measure_vertical_angle(
                lambda keyframe_id: self._log.cloud(keyframe_id)[0],
                result.odometry.T_world_lidar[result.keyframe_rows],
                self._slam.graph.travel_m,
                config=self.config.refine,
                motion_variance=self._slam.graph.motion_variance,
            )
        )
        return {} if found is None else {"vertical_deg": found.angle_deg, "vertical_sigma_deg": found.sigma_deg}

    def _read(self, dataset: Dataset) -> Iterator[tuple[Scan | BadScan, Scan | BadScan | None]]:
        """Each scan, and the one after it."""
        yield from pairwise(chain(_without_late(self._scans(dataset)), [None]))

    def _scans(self, dataset: Dataset) -> Iterator[Scan | BadScan]:
        for row in range(self._next_row, len(dataset)):
            with self._timed("read"):
                try:
                    scan: Scan | BadScan = dataset[row]
                except BadScan as error:
                    scan = error
            yield scan

    def _track(self, scans: tuple[Scan | BadScan, Scan | BadScan | None]) -> Tracked | BadScan:
        scan, ahead = scans
        if isinstance(scan, BadScan):
            return scan
        try:
            return self._slam.track(scan, ahead=ahead if isinstance(ahead, Scan) else None)
        except BadScan as error:
            return error

    def _logged(self, step: Step) -> Step:
        with self._timed("log"):
            self._log.write(step)
            self.num_steps += 1
            if self.num_steps == 1:
                settle(self.folder)
            if self.num_steps % TRIM_EVERY == 0:
                give_back()  # or gaps of freed memory add up over a drive
            while self._unreported:
                self._report(self._unreported.pop(0))
        for stage, seconds in step.stage_seconds.items():
            self._note_ms(stage, seconds)
        return step

    def _report(self, bad: BadScan) -> None:
        if self.num_steps:
            logger.warning("%s; skipped", bad)
            self._log.warn(f"{bad}; skipped")
        else:
            self._unreported.append(bad)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Context manager that notes the time within it."""
        started = perf_counter()
        yield
        self._note_ms(stage, perf_counter() - started)

    def _note_ms(self, stage: str, seconds: float) -> None:
        self._stage_ms[stage].append(1000 * seconds)


def _without_late(scans: Iterator[Scan | BadScan]) -> Iterator[Scan | BadScan]:
    """The scans, but for those whose stamp alone is too late: the next scan follows the one before in time.

    Otherwise all scans until that time would not be later than the previous one.
    """
    last_ns: float = -math.inf
    for scan, following in pairwise(chain(scans, [None])):
        if isinstance(scan, Scan) and isinstance(following, Scan) and last_ns < following.stamp_ns < scan.stamp_ns:
            yield BadScan(
                f"scan {scan.index}: its stamp {scan.stamp_ns} ns is later than that of the next scan, "
                f"{following.stamp_ns} ns; correct the stamps"
            )
            continue
        if isinstance(scan, Scan):
            last_ns = max(last_ns, scan.stamp_ns)
        if scan is not None:
            yield scan


def _other_data(log: Path, difference: str) -> SegslamError:
    return SegslamError(f"{log}: {difference}; resume with the data of the interrupted run")
