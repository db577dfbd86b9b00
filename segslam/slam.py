"""The whole pipeline, one call a scan. It knows no file and no viewer: whoever wants to see consumes the Steps."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from segslam import geometry, refine, segregator, verify
from segslam.alignment import Labeller, PreparedScan, Stopwatch, align, shape_labels
from segslam.config import Config
from segslam.keyframes import KeyframeSelector, thin
from segslam.odometry import KissOdometry, Odometry, OdometryResult
from segslam.pose_graph import PoseGraph
from segslam.proximity import ProximityDetector
from segslam.trajectory import corrected_poses
from segslam.types import (
    Alignment,
    Description,
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

NUM_SURFACES_KEPT = 64
"""Search trees in memory, some 2 MB each; others are built again from thinned points in some 10 ms."""


@dataclass(frozen=True, slots=True, eq=False)
class SlamResult:
    """The end of a run: the pose of every scan before and after loop closing, and how it came about."""

    trajectory: Trajectory
    odometry: Trajectory
    estimate: GraphEstimate
    keyframe_rows: Indices
    """Row of each keyframe, by id, in the two trajectories."""
    attempts: tuple[LoopAttempt, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """What stays in memory of a keyframe."""

    description: Description
    thinned: Points
    view: verify.View


class Slam:
    """Odometry, keyframes, loops and graph. `process` each scan in order of time, then `finish`."""

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
        self._kept: list[_Kept] = []
        self._prepared: Callable[[int], PreparedScan] = lru_cache(NUM_SURFACES_KEPT)(self._prepare)
        self._steps: list[tuple[int, int, Transform]] = []
        self._keyframe_rows: list[int] = []
        self._attempts: list[LoopAttempt] = []

    def process(self, scan: Scan) -> Step:
        """All that this scan causes. Raises BadScan, and forgets the scan, if it cannot be used."""
        watch = Stopwatch()
        with watch("odometry"):
            registered = self._odometry.register(scan)
        keyframe = None
        if self._selector.update(registered.T_odom_lidar):
            with watch("keyframe"):
                keyframe = self._cut(scan, registered)
        return self._advance(scan.index, scan.stamp_ns, registered.T_odom_lidar, keyframe, watch)

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

    def finish(self) -> SlamResult:
        """Optimise once more, and give the pose of every scan. Raises ValueError before the first scan."""
        if not self._steps:
            raise ValueError("no scan was processed")
        estimate = self.graph.finish()
        odometry = Trajectory(
            scan_index=np.array([index for index, _, _ in self._steps]),
            stamp_ns=np.array([stamp_ns for _, stamp_ns, _ in self._steps]),
            T_world_lidar=np.stack([T_odom_lidar for _, _, T_odom_lidar in self._steps]),
        )
        rows = np.array(self._keyframe_rows)
        T_world_lidar = corrected_poses(odometry.T_world_lidar, rows, self.graph.T_world_keyframes)
        trajectory = replace(odometry, T_world_lidar=T_world_lidar)
        return SlamResult(trajectory, odometry, estimate, rows, tuple(self._attempts))

    def _advance(
        self, scan_index: int, stamp_ns: int, T_odom_lidar: Transform, keyframe: Keyframe | None, watch: Stopwatch
    ) -> Step:
        self._steps.append((scan_index, stamp_ns, T_odom_lidar))
        attempts: tuple[LoopAttempt, ...] = ()
        estimate = None
        if keyframe is not None:
            self._keep(keyframe, watch)
            attempts = self._close_loops(keyframe.id, watch)
            self._attempts += attempts
            if any(isinstance(attempt.outcome, LoopClosure) for attempt in attempts):
                with watch("optimize"):
                    estimate = self.graph.optimize()
        return Step(scan_index, stamp_ns, T_odom_lidar, keyframe, attempts, estimate, watch.seconds)

    def _cut(self, scan: Scan, registered: OdometryResult) -> Keyframe:
        """A keyframe of this scan, labelled by shape if it came without labels, and thinned to what is kept."""
        labels = registered.labels if registered.labels.any() else self._labeller(registered.points)
        points, labels = thin(
            registered.points,
            labels,
            config=self.config.keyframes,
            whole_classes=tuple(self.config.segregator.cluster_min_points),
        )
        return Keyframe(
            id=self.graph.num_keyframes,
            scan_index=scan.index,
            stamp_ns=scan.stamp_ns,
            T_odom_keyframe=registered.T_odom_lidar,
            travel_m=self._selector.travel_m,
            points=points,
            labels=labels,
        )

    def _keep(self, keyframe: Keyframe, watch: Stopwatch) -> None:
        with watch("describe"):
            description = segregator.describe(keyframe.points, keyframe.labels, config=self.config.segregator)
            thinned = refine.thin(keyframe.points, config=self.config.refine)
            self._kept.append(_Kept(description, thinned, verify.view(keyframe.points)))
        self._keyframe_rows.append(len(self._steps) - 1)
        self.graph.add_keyframe(keyframe.id, keyframe.T_odom_keyframe, keyframe.travel_m)

    def _prepare(self, keyframe_id: int) -> PreparedScan:
        kept = self._kept[keyframe_id]
        return PreparedScan(kept.description, refine.prepare(kept.thinned, config=self.config.refine), kept.view)

    def _close_loops(self, keyframe_id: int, watch: Stopwatch) -> tuple[LoopAttempt, ...]:
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
            source, target = self._prepared(candidate.source_id), self._prepared(candidate.target_id)
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
