"""The whole pipeline, with one call per scan.

It uses no files and no viewers; these consume the Steps that it returns.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from time import monotonic

import numpy as np

from segslam.core.config import Config, check_config
from segslam.core.errors import counted
from segslam.core.memory import give_back
from segslam.core.processes import Progress, no_progress
from segslam.core.threads import Stopwatch
from segslam.core.trajectory import corrected_poses
from segslam.core.types import (
    BadScan,
    GraphEstimate,
    Keyframe,
    LoopAttempt,
    LoopClosure,
    Motion,
    MotionState,
    Scan,
    SegslamError,
    Step,
    Trajectory,
    Transform,
)
from segslam.graph import AnchoredGraph, PoseGraph
from segslam.keyframes import Clouds, CloudStore, downsample_keyframe
from segslam.labels import geometric_labels
from segslam.labels.label_files import computed
from segslam.odometry.motion_model import information_of
from segslam.odometry.sweep import Odometry, OdometryResult
from segslam.odometry.tracker import Tracked as Tracked
from segslam.odometry.tracker import Tracker
from segslam.registration.prepared import Labeller
from segslam.slam.adjustment.known import Known
from segslam.slam.adjustment.rounds import adjust
from segslam.slam.adjustment.sweeps import velocities_of
from segslam.slam.loop_edits import NO_EDITS, LoopEdits
from segslam.slam.loops import ROUNDS, LoopCloser
from segslam.slam.slam_result import SlamResult as SlamResult

logger = logging.getLogger(__name__)


class Slam:
    """Odometry, keyframes, loops and graph. `process` each scan in order of time, then `finish`.

    `process` is `track` followed by `close_loops`. `track` does not use results of `close_loops`, so the two may run in
    two threads, with one call per scan in order; the steps are the same.
    """

    def __init__(
        self,
        config: Config | None = None,
        *,
        odometry: Odometry | None = None,
        labeller: Labeller | None = None,
        edits: LoopEdits = NO_EDITS,
        known: Known | None = None,
    ) -> None:
        """`odometry` replaces KISS-ICP; `labeller` replaces the geometric labels of scans without labels.

        `edits` forbids loops between keyframes, or has them tried. `known`: results of the drives' own adjustments, if
        several are repeated as one.
        """
        check_config(config)
        self.config = config or Config()
        self.known = known
        self._tracker = Tracker(self.config, odometry=odometry)
        self._labeller = labeller
        self.graph = self._new_graph()
        self._clouds: Clouds = CloudStore(self.config.keyframes.resolution_m)
        self._loops = LoopCloser(
            self.config,
            self.graph,
            lambda number: self._clouds.cloud(number),
            geometric_labels,
            edits,
            is_known=known is not None,
        )
        self._steps: list[tuple[int, int, Transform]] = []
        self._motions: list[Motion] = []
        self._keyframe_rows: list[int] = []
        self._attempts: list[LoopAttempt] = []
        self._is_finished = False
        self._result: SlamResult | None = None

    def __repr__(self) -> str:
        num_loops = sum(isinstance(attempt.outcome, LoopClosure) for attempt in self._attempts)
        numbers = {"scan": len(self._steps), "keyframe": len(self._keyframe_rows), "loop": num_loops}
        state = "finished" if self._is_finished else "running"
        return f"Slam({', '.join(counted(number, thing) for thing, number in numbers.items())}, {state})"

    def _new_graph(self) -> PoseGraph:
        return PoseGraph(self.config.graph)

    def keep_clouds_in(self, clouds: Clouds) -> None:
        """Store the points of keyframes in `clouds` instead of memory. Call it before the first scan."""
        self._clouds = clouds

    def process(self, scan: Scan) -> Step:
        """Process one scan; returns a Step with all results that it caused.

        Raises BadScan, and ignores the scan, if it cannot be used, is not later than the previous scan, or has the
        index of another. Raises SegslamError after `finish`.
        """
        return self.close_loops(self.track(scan))

    def track(self, scan: Scan, *, ahead: Scan | None = None) -> Tracked:
        """Estimate the pose of a scan, and decide whether it becomes a keyframe. Raises BadScan as `process` does.

        `ahead`: the scan that is tracked next, if it is known: saves time.
        """
        if not isinstance(scan, Scan):
            raise SegslamError(f"scan: a {type(scan).__name__}; give a Scan, as in Scan(points, stamp_ns)")
        if self._is_finished:
            raise SegslamError(f"scan {scan.index}: the run is finished; map further scans with a new Slam")
        return self._tracker.track(scan, ahead=ahead)

    def close_loops(self, tracked: Tracked, *, tries_loops: bool = True) -> Step:
        """Close the loops of a tracked scan. Loops that are not tried now may be tried in the search of `finish`."""
        keyframe = None if tracked.registered is None else self._cut(tracked, tracked.registered)
        step = Step(tracked.scan_index, tracked.stamp_ns, tracked.T_odom_lidar, keyframe, (), None, {}, tracked.motion)
        return self._advance(step, tracked.watch, self._loops.attempt if tries_loops else lambda *_: ())

    def repeat(self, recorded: Step) -> Step:
        """As `process`, but from a recorded Step: repeat everything after the selection of the keyframe."""
        self._tracker.note(recorded)
        keyframe = None
        if recorded.keyframe is not None:  # its travel is that of earlier versions otherwise, where breaks were long
            keyframe = replace(recorded.keyframe, place=None, travel_m=self._tracker.travel_m)
        return self._advance(replace(recorded, keyframe=keyframe), Stopwatch(), self._loops.attempt)

    def take(self, recorded: Step, below: int = 0, optimize: bool = False) -> Step:
        """As `repeat`, but with the recorded loops and places.

        Further loops are searched among keyframes with ids below `below`. The graph is optimised only with `optimize`.
        """

        def attempts(keyframe_id: int, watch: Stopwatch) -> tuple[LoopAttempt, ...]:
            self._loops.take(recorded.attempts)
            return (*recorded.attempts, *(self._loops.attempt(keyframe_id, watch, below=below) if below else ()))

        return self._advance(recorded, Stopwatch(), attempts, optimize=optimize)

    def resume(self, scan_of: Callable[[int], Scan]) -> None:
        """Prepare `process` to continue after `repeat`.

        `scan_of` reads the scan of a step, counted from 0, if needed.
        """
        if self._steps:
            odometry = self._odometry()
            self._tracker.resume(odometry.T_world_lidar, odometry.stamp_ns, scan_of)

    def finish(self, *, search_s: float = math.inf, progress: Progress = no_progress) -> SlamResult:
        """Final optimisation; returns the pose of every scan. Raises SegslamError before the first scan.

        Loops are then searched again with the final poses, for at most `search_s` seconds. The adjustment of the whole
        map follows, with `progress`. Later calls return the same result.
        """
        if self._result is not None:
            return self._result
        if not self._steps:
            raise SegslamError("no scan was processed; give at least one that can be used before `finish`")
        self._is_finished = True
        estimate, late = self._settle(monotonic() + search_s)
        self._loops.forget()
        give_back()  # the adjustment needs most
        odometry = self._odometry()
        rows = np.array(self._keyframe_rows)
        adjusted = None
        if not isinstance(self.graph, AnchoredGraph):  # an existing map stays as it is
            adjusted = adjust(
                self.graph,
                estimate,
                lambda keyframe_id: self._clouds.cloud(keyframe_id)[0],
                velocities_of(odometry, rows, self._motions),
                config=self.config,
                known=self.known,
                progress=progress,
            )
        T_world_lidar = corrected_poses(
            odometry.T_world_lidar,
            rows,
            self.graph.T_world_keyframes,
            after_break=np.array([self._motions[row].is_break for row in self._keyframe_rows]),
        )
        alone = self._tracker.alone()[: len(odometry)]  # tracking may be ahead when a run is stopped
        self._result = SlamResult(
            replace(odometry, T_world_lidar=T_world_lidar),
            odometry,
            estimate if adjusted is None else adjusted.after,
            rows,
            (*self._attempts, *late),
            tuple(self._motions),
            len(late),
            adjusted=adjusted,
            alone=replace(odometry, T_world_lidar=np.stack(alone)) if len(alone) == len(odometry) else None,
        )
        return self._result

    def _settle(self, end_s: float) -> tuple[GraphEstimate, list[LoopAttempt]]:
        """The final estimate, after a second search for loops with better poses; and the attempts of that search.

        The search ends at `end_s`, by time.monotonic.
        """
        late: list[LoopAttempt] = []
        estimate = self.graph.finish()
        for _ in range(ROUNDS):
            if monotonic() >= end_s:
                break
            self._loops.detector.note_estimate(estimate.closure_weights)
            found = list(self._loops.search_again(Stopwatch(), end_s=end_s))
            late += found
            if not any(isinstance(attempt.outcome, LoopClosure) for attempt in found):
                break
            estimate = self.graph.finish()
        return estimate, late

    def _odometry(self) -> Trajectory:
        scan_index, stamp_ns, T_odom_lidar = zip(*self._steps, strict=True)
        return Trajectory(np.array(scan_index), np.array(stamp_ns), np.stack(T_odom_lidar))

    def _advance(
        self,
        step: Step,
        watch: Stopwatch,
        attempts_of: Callable[[int, Stopwatch], tuple[LoopAttempt, ...]],
        *,
        optimize: bool | None = None,
    ) -> Step:
        """Everything after the selection of the keyframe. The graph is optimised if `optimize`; None: if it is due."""
        motion, keyframe = step.motion or Motion(MotionState.UNCHECKED), step.keyframe
        about = step.scan_index, step.stamp_ns, step.T_odom_lidar
        self._steps.append(about)
        self._motions.append(motion)
        attempts: tuple[LoopAttempt, ...] = ()
        estimate = None
        if keyframe is not None:
            self._clouds.keep(keyframe)
            since_last = self._motions[self._keyframe_rows[-1] + 1 :] if self._keyframe_rows else self._motions
            self._keyframe_rows.append(len(self._steps) - 1)
            self.graph.add_keyframe(
                keyframe.id,
                keyframe.T_odom_keyframe,
                keyframe.travel_m,
                information=information_of(since_last),
                stamp_ns=keyframe.stamp_ns,
            )
            with watch("recognise"):
                place = self._loops.add(
                    keyframe.T_odom_keyframe,
                    labelled_by_shape=bool(keyframe.labelled_by_shape),
                    recorded=keyframe.place,
                )
            keyframe = replace(keyframe, place=None if place is None else place.to_bytes())
            attempts = attempts_of(keyframe.id, watch)
            self._attempts += attempts
            if self.graph.is_due if optimize is None else optimize:
                with watch("optimize"):
                    estimate = self.graph.optimize()
                self._loops.detector.note_estimate(estimate.closure_weights)
        return Step(*about, keyframe, attempts, estimate, watch.seconds, motion)

    def _cut(self, tracked: Tracked, registered: OdometryResult) -> Keyframe:
        """A keyframe of this scan, downsampled; geometric labels are computed if it has none."""
        with tracked.watch("label"):
            try:
                labels = computed(registered.labels)
            except BadScan as error:  # the scan is part of the drive already
                logger.warning("%s; its labels are left out", error)
                labels = np.zeros(len(registered.points), np.uint8)
            is_unlabelled = not labels.any()
            if is_unlabelled:
                labels = (self._labeller or geometric_labels)(registered.points)
        with tracked.watch("keyframe"):
            points, labels, rows = downsample_keyframe(
                registered.points,
                labels,
                config=self.config.keyframes,
                whole_classes=tuple(self.config.segregator.cluster_min_points),
            )
        return Keyframe(
            id=self.graph.num_keyframes,
            scan_index=tracked.scan_index,
            stamp_ns=tracked.stamp_ns,
            T_odom_keyframe=tracked.T_odom_lidar,
            travel_m=tracked.travel_m,
            points=points,
            labels=labels,
            intensities=None if registered.intensities is None else registered.intensities[rows],
            labelled_by_shape=True if is_unlabelled and self._labeller is None else None,
        )
