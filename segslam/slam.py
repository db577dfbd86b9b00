"""The whole pipeline, one call a scan. It knows no file and no viewer: whoever wants to see consumes the Steps."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from segslam import geometry
from segslam.alignment import Labeller, PreparedScan, Stopwatch, align, prepare_scan, shape_labels
from segslam.beside import both
from segslam.config import Config
from segslam.keyframes import Clouds, CloudStore, KeyframeSelector, thin
from segslam.odometry import KissOdometry, Odometry, OdometryResult
from segslam.pose_graph import PoseGraph
from segslam.proximity import ProximityDetector
from segslam.straightening import sample, straighten
from segslam.trajectory import corrected_poses
from segslam.types import (
    Alignment,
    AngleSamples,
    DriftEvidence,
    GraphEstimate,
    Indices,
    Keyframe,
    LoopAttempt,
    LoopCandidate,
    LoopClosure,
    Points,
    Registration,
    Rejected,
    RejectReason,
    Scan,
    Step,
    Trajectory,
    Transform,
)

NUM_PREPARED = 64
"""Keyframes ready for alignment in memory, some 2 MB each; others are made ready again, in some 40 ms."""


@dataclass(frozen=True, slots=True, eq=False)
class SlamResult:
    """The end of a run: the pose of every scan before and after loop closing, and how it came about."""

    trajectory: Trajectory
    odometry: Trajectory
    estimate: GraphEstimate
    keyframe_rows: Indices
    """Row of each keyframe, by id, in the two trajectories."""
    attempts: tuple[LoopAttempt, ...]
    drift: DriftEvidence | None = None
    """None where nobody asked, or the run was read from its log."""
    angles: AngleSamples | None = None
    """What led to that."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """A scan that odometry has placed. What follows, `Slam.close_loops`, may be done while the next is tracked."""

    scan_index: int
    stamp_ns: int
    registered: OdometryResult | None
    """What a keyframe is cut from; None where none is to be cut."""
    T_odom_lidar: Transform
    travel_m: float
    watch: Stopwatch


class Slam:
    """Odometry, keyframes, loops and graph. `process` each scan in order of time, then `finish`.

    `process` is `track` and then `close_loops`. The first never waits for what the second finds, so the two may run in
    two threads, each called for one scan after the other: the steps are the same.
    """

    def __init__(
        self, config: Config | None = None, *, odometry: Odometry | None = None, labeller: Labeller | None = None
    ) -> None:
        """`odometry` replaces KISS-ICP; `labeller` replaces the geometric labels given to scans without any."""
        self.config = config or Config()
        self._odometry = odometry or KissOdometry(self.config.odometry)
        self._labeller = labeller or partial(shape_labels, config=self.config)
        self._selector = KeyframeSelector(self.config.keyframes)
        self._detector = ProximityDetector(self.config.proximity)
        self.graph = PoseGraph(self.config.graph)
        self._clouds: Clouds = CloudStore(self.config.keyframes.resolution_m)
        self._prepared: Callable[[int], PreparedScan] = lru_cache(NUM_PREPARED)(self._prepare)
        self._steps: list[tuple[int, int, Transform]] = []
        self._keyframe_rows: list[int] = []
        self._attempts: list[LoopAttempt] = []

    def keep_clouds_in(self, clouds: Clouds) -> None:
        """Have the points of keyframes in another place than in memory; before the first scan."""
        self._clouds = clouds

    def process(self, scan: Scan) -> Step:
        """All that this scan causes. Raises BadScan, and forgets the scan, if it cannot be used."""
        return self.close_loops(self.track(scan))

    def track(self, scan: Scan) -> Tracked:
        """Where the scan was taken, and whether it becomes a keyframe. Raises BadScan as `process` does."""
        watch = Stopwatch()
        with watch("odometry"):
            registered = self._odometry.register(scan)
        T_odom_lidar = registered.T_odom_lidar
        is_keyframe = self._selector.update(T_odom_lidar)
        kept = registered if is_keyframe else None
        return Tracked(scan.index, scan.stamp_ns, kept, T_odom_lidar, self._selector.travel_m, watch)

    def close_loops(self, tracked: Tracked) -> Step:
        """What follows from a scan that was tracked."""
        keyframe = None
        if tracked.registered is not None:
            with tracked.watch("keyframe"):
                keyframe = self._cut(tracked, tracked.registered)
        return self._advance(tracked.scan_index, tracked.stamp_ns, tracked.T_odom_lidar, keyframe, tracked.watch)

    def repeat(self, recorded: Step) -> Step:
        """As `process`, from a Step that was made before: all from the keyframe on is done again."""
        self._selector.update(recorded.T_odom_lidar)
        return self._advance(
            recorded.scan_index, recorded.stamp_ns, recorded.T_odom_lidar, recorded.keyframe, Stopwatch()
        )

    def go_on(self, scan_of: Callable[[int], Scan]) -> None:
        """Let `process` follow on `repeat`. `scan_of` reads the scan of a step, counted from 0, where it is needed."""
        if self._steps:
            self._odometry.restore(np.stack([T_odom_lidar for _, _, T_odom_lidar in self._steps]), scan_of)

    def finish(self, angles: AngleSamples | None = None) -> SlamResult:
        """Optimise once more, and give the pose of every scan. Raises ValueError before the first scan.

        `angles`: what these scans told an earlier run with the same settings of `refine` of leftover angles; they are
        not asked again.
        """
        if not self._steps:
            raise ValueError("no scan was processed")
        drift = None
        if self.config.graph.systematic_drift == "auto":
            angles = self._sample_angles() if angles is None else angles
            drift = self._straighten(angles)
        estimate = self.graph.finish()
        odometry = Trajectory(
            scan_index=np.array([index for index, _, _ in self._steps]),
            stamp_ns=np.array([stamp_ns for _, stamp_ns, _ in self._steps]),
            T_world_lidar=np.stack([T_odom_lidar for _, _, T_odom_lidar in self._steps]),
        )
        rows = np.array(self._keyframe_rows)
        T_world_lidar = corrected_poses(odometry.T_world_lidar, rows, self.graph.T_world_keyframes)
        trajectory = replace(odometry, T_world_lidar=T_world_lidar)
        return SlamResult(trajectory, odometry, estimate, rows, tuple(self._attempts), drift, angles if drift else None)

    def _advance(
        self, scan_index: int, stamp_ns: int, T_odom_lidar: Transform, keyframe: Keyframe | None, watch: Stopwatch
    ) -> Step:
        self._steps.append((scan_index, stamp_ns, T_odom_lidar))
        attempts: tuple[LoopAttempt, ...] = ()
        estimate = None
        if keyframe is not None:
            self._clouds.keep(keyframe)
            self._keyframe_rows.append(len(self._steps) - 1)
            self.graph.add_keyframe(keyframe.id, keyframe.T_odom_keyframe, keyframe.travel_m)
            attempts = self._attempt_loops(keyframe.id, watch)
            self._attempts += attempts
            if self.graph.is_due:
                with watch("optimize"):
                    estimate = self.graph.optimize()
                self._detector.note_estimate()
        return Step(scan_index, stamp_ns, T_odom_lidar, keyframe, attempts, estimate, watch.seconds)

    def _cut(self, tracked: Tracked, registered: OdometryResult) -> Keyframe:
        """A keyframe of this scan, labelled by shape if it came without labels, and thinned to what is kept."""
        labels = registered.labels if registered.labels.any() else self._labeller(registered.points)
        points, labels, rows = thin(
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
        )

    def _sample_angles(self) -> AngleSamples:
        T_odom_keyframes = np.stack([self._steps[row][2] for row in self._keyframe_rows])
        return sample(self._points, T_odom_keyframes, self.graph.travel_m, config=self.config.refine)

    def _straighten(self, angles: AngleSamples) -> DriftEvidence:
        closures = [attempt.outcome for attempt in self._attempts if isinstance(attempt.outcome, LoopClosure)]
        return straighten(self.graph, closures, angles, self._points, config=self.config.refine)

    def _points(self, keyframe_id: int) -> Points:
        return self._clouds.cloud(keyframe_id)[0]

    def _prepare(self, keyframe_id: int) -> PreparedScan:
        points, labels = self._clouds.cloud(keyframe_id)
        return prepare_scan(points, labels, config=self.config)

    def _attempt_loops(self, keyframe_id: int, watch: Stopwatch) -> tuple[LoopAttempt, ...]:
        with watch("propose"):
            candidates = self._detector.candidates(keyframe_id, self.graph.T_world_keyframes, self.graph.travel_m)
        attempts = tuple(self._attempt(candidate, watch) for candidate in candidates)
        for attempt in attempts:
            if isinstance(attempt.outcome, LoopClosure):
                self.graph.add_closure(attempt.outcome)
                self._detector.note_closure(attempt.outcome)
        return attempts

    def _attempt(self, candidate: LoopCandidate, watch: Stopwatch) -> LoopAttempt:
        own = Stopwatch()
        with own("prepare"):
            source, target = both(self._prepared, (candidate.source_id,), (candidate.target_id,))
        outcome = align(
            source,
            target,
            config=self.config,
            gate=lambda coarse: _far_from_prior(coarse, candidate, self.config.verify.prior_gate),
            watch=own,
        )
        for stage, seconds in own.seconds.items():
            watch.add(stage, seconds)
        return LoopAttempt(candidate, _closure(candidate, outcome), own.seconds)


def _far_from_prior(coarse: Registration, candidate: LoopCandidate, gate: float) -> Rejected | None:
    """A coarse pose that puts the source farther from where the graph has it than drift can explain."""
    T_prior_coarse = geometry.inverse(candidate.T_target_source_prior) @ coarse.T_target_source
    apart_m = geometry.distance(T_prior_coarse)
    allowed_m = gate * candidate.search_radius_m
    if apart_m > allowed_m:
        return Rejected(RejectReason.FAR_FROM_PRIOR, f"{apart_m:.1f} m > {allowed_m:.1f} m")
    return None


def _closure(candidate: LoopCandidate, outcome: Alignment | Rejected) -> LoopClosure | Rejected:
    if isinstance(outcome, Rejected):
        return outcome
    fine = outcome.fine
    return LoopClosure(candidate.source_id, candidate.target_id, fine.T_target_source, fine.information, outcome)
