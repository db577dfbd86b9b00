"""Visualisation of a run, step by step, as Foxglove messages: drawings, and what happens in words."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message

from segslam.core import geometry
from segslam.core.points import voxel_first, within_range
from segslam.core.types import (
    CloudOf,
    GraphEstimate,
    Keyframe,
    Label,
    Labels,
    LoopAttempt,
    LoopClosure,
    MotionState,
    Points,
    Rejected,
    RejectReason,
    Step,
    Trajectory,
    Transform,
    Vector,
    probability_text,
)
from segslam.output.log import foxglove, schema
from segslam.output.log.foxglove import timestamp
from segslam.output.log.records import codec

ACCEPTED_COLOR = "#2ca02cff"
REJECTED_COLORS = {
    RejectReason.TOO_FEW_POINTS: "#c7c7c7ff",
    RejectReason.TOO_FEW_CORRESPONDENCES: "#7f7f7fff",
    RejectReason.SMALL_CLIQUE: "#1f77b4ff",
    RejectReason.DEGENERATE: "#17becfff",
    RejectReason.TOO_FEW_INLIERS: "#9467bdff",
    RejectReason.FAR_FROM_PRIOR: "#e377c2ff",
    RejectReason.REFINEMENT_DIVERGED: "#8c564bff",
    RejectReason.LOW_OVERLAP: "#bcbd22ff",
    RejectReason.HIGH_RESIDUAL: "#ffbb78ff",
    RejectReason.FREE_SPACE_VIOLATED: "#dbdb8dff",
    RejectReason.IMPROBABLE: "#ff7f0eff",
    RejectReason.AMBIGUOUS: "#d62728ff",
    RejectReason.NO_PLACE: "#aec7e8ff",
    RejectReason.UNCONFIRMED: "#ff9896ff",
}
"""Cold colours for candidates rejected early, warm colours for those rejected late."""

PATH_GROWTH = 1.05
"""Chosen: a path is written again when it has grown by this factor. The size of all versions together is then
linear in its length (about 20 times the last), and a viewer that jumps in time shows at least 95 % of the path."""

VIEW_EVERY = 8
"""Chosen: viewers get every eighth point of a keyframe; replay uses all points."""
VIEW_GRID_M = 2.0**-5
"""Chosen: displayed points are rounded to 3 cm (a binary fraction), which halves their compressed size."""

MAP_KEYFRAMES = 500
"""Chosen: in longer drives, every second keyframe is in the displayed map, or every third, and so on."""
MAP_BATCH = 50
"""Chosen: number of keyframes after which the displayed map is downsampled again, which limits the memory."""
MAP_RANGE_M, MAP_VOXEL_M = 40.0, 0.2

Topical = tuple[str, Message]
INFO, WARNING = Log.Level.Value("INFO"), Log.Level.Value("WARNING")


class Drawing:
    """Converts the steps of a run to messages by topic."""

    def __init__(self) -> None:
        self._T_odom_keyframe: dict[int, Transform] = {}
        self._T_world_keyframe: Mapping[int, Transform] = {}
        self._T_world_odom = np.eye(4)
        self._num_on_path = 0
        self._rejected: set[str] = set()
        """Identities of the drawn rejected loops."""

    def draw(self, step: Step, *, path: bool = True) -> Iterator[Topical]:
        """The messages of the next step; without `path`, not those of an estimate whose size grows with the drive."""
        yield (
            schema.TRANSFORMS,
            foxglove.frame_transform(step.T_odom_lidar, parent=schema.ODOM, child=schema.LIDAR, stamp_ns=step.stamp_ns),
        )
        if step.keyframe is not None:
            yield from self._keyframe(step.keyframe, corrected=step.estimate is None or not path)
        if step.estimate is not None:
            yield from self.draw_estimate(step.estimate, stamp_ns=step.stamp_ns, path=path)
        else:
            yield self._odom_in_world(step.stamp_ns)
        yield from self._attempts(step.attempts, step.stamp_ns)
        yield from _words_of(step)

    def draw_estimate(self, estimate: GraphEstimate, *, stamp_ns: int, path: bool = True) -> Iterator[Topical]:
        """Pose of odom in world and, if `path`, the corrected path and the closures."""
        self._T_world_keyframe = estimate.T_world_keyframe
        last = max(estimate.T_world_keyframe)
        self._T_world_odom = estimate.T_world_keyframe[last] @ geometry.inverse(self._T_odom_keyframe[last])
        yield self._odom_in_world(stamp_ns)
        if path:
            yield schema.TRAJECTORY, foxglove.path(estimate.T_world_keyframe.values(), stamp_ns=stamp_ns)
            yield schema.GRAPH, self._graph(estimate, stamp_ns)

    def _odom_in_world(self, stamp_ns: int) -> Topical:
        """Written at every step: viewers interpolate, and would otherwise start a correction too early."""
        return schema.TRANSFORMS, foxglove.frame_transform(
            self._T_world_odom, parent=schema.WORLD, child=schema.ODOM, stamp_ns=stamp_ns
        )

    def _keyframe(self, keyframe: Keyframe, *, corrected: bool) -> Iterator[Topical]:
        """Its points, and now and then the paths: by odometry and, with `corrected`, in world as far as it is known."""
        self._T_odom_keyframe[keyframe.id] = keyframe.T_odom_keyframe
        stamp_ns, some = keyframe.stamp_ns, slice(None, None, VIEW_EVERY)
        points = np.round(keyframe.points[some] / VIEW_GRID_M) * VIEW_GRID_M
        yield (
            schema.POINTS,
            foxglove.point_cloud(points, keyframe.labels[some], frame=schema.LIDAR, stamp_ns=stamp_ns),
        )
        if len(self._T_odom_keyframe) >= PATH_GROWTH * self._num_on_path:
            self._num_on_path = len(self._T_odom_keyframe)
            yield schema.ODOMETRY, foxglove.path(self._T_odom_keyframe.values(), stamp_ns=stamp_ns)
            if corrected:
                poses = [self._in_world(number) for number in self._T_odom_keyframe]
                yield schema.TRAJECTORY, foxglove.path(poses, stamp_ns=stamp_ns)

    def _attempts(self, attempts: tuple[LoopAttempt, ...], stamp_ns: int) -> Iterator[Topical]:
        accepted = [self._attempt(one, stamp_ns) for one in attempts if isinstance(one.outcome, LoopClosure)]
        rejected = [self._attempt(one, stamp_ns) for one in attempts if isinstance(one.outcome, Rejected)]
        if accepted:
            yield schema.ACCEPTED, foxglove.scene(accepted)
        if outdated := self._rejected & {entity.id for entity in accepted}:  # loops that waited for confirmation
            yield schema.REJECTED, foxglove.scene([], deleted=outdated)
        if rejected:
            yield schema.REJECTED, foxglove.scene(rejected)
        self._rejected = self._rejected - outdated | {entity.id for entity in rejected}

    def _attempt(self, attempt: LoopAttempt, stamp_ns: int) -> foxglove.SceneEntity:
        outcome, pair = attempt.outcome, attempt.candidate.pair
        color = REJECTED_COLORS[outcome.reason] if isinstance(outcome, Rejected) else ACCEPTED_COLOR
        about = numbers_and_words(codec(LoopAttempt).encode(attempt))
        return foxglove.lines(f"{pair[0]} to {pair[1]}", self._ends([pair]), [color], about, stamp_ns=stamp_ns)

    def _graph(self, estimate: GraphEstimate, stamp_ns: int) -> foxglove.SceneUpdate:
        colors = [weight_color(weight) for weight in estimate.closure_weights.values()]
        about = {"error": f"{estimate.error:g}", "closures": str(len(colors))}
        ends = self._ends(estimate.closure_weights)
        return foxglove.scene([foxglove.lines("closures", ends, colors, about, stamp_ns=stamp_ns)])

    def _ends(self, pairs: Iterable[tuple[int, int]]) -> list[Vector]:
        """Positions in world of the keyframes of each pair, by the last estimate and the odometry since."""
        return [self._in_world(keyframe_id)[:3, 3] for pair in pairs for keyframe_id in pair]

    def _in_world(self, keyframe_id: int) -> Transform:
        if keyframe_id in self._T_world_keyframe:
            return self._T_world_keyframe[keyframe_id]
        return self._T_world_odom @ self._T_odom_keyframe[keyframe_id]


def map_points(T_world_keyframe: Mapping[int, Transform], cloud: CloudOf) -> tuple[Points, Labels]:
    """Some points (n, 3) of static classes, in world, of `MAP_KEYFRAMES` to twice as many keyframes; their labels."""
    every = 1 + len(T_world_keyframe) // MAP_KEYFRAMES
    some = slice(None, None, VIEW_EVERY)
    ids = list(T_world_keyframe)[::every]
    drawn = np.empty((0, 3)), np.empty(0, np.uint8)
    for start in range(0, len(ids), MAP_BATCH):
        parts = [drawn]
        for keyframe_id in ids[start : start + MAP_BATCH]:
            points, labels = cloud(keyframe_id)
            kept = within_range(points[some], 0.0, MAP_RANGE_M) & (labels[some] < Label.MOVING_CAR)
            placed = geometry.apply(T_world_keyframe[keyframe_id], points[some][kept].astype(np.float64))
            parts.append((placed, labels[some][kept]))
        points, labels = (np.concatenate(column) for column in zip(*parts, strict=True))
        rows = voxel_first(points, MAP_VOXEL_M)
        drawn = points[rows], labels[rows]
    points, labels = drawn
    return np.round(points / VIEW_GRID_M) * VIEW_GRID_M, labels


def map_message(points: Points, labels: Labels, *, stamp_ns: int) -> Topical:
    """The message of the displayed map, a cloud in world."""
    return schema.MAP, foxglove.point_cloud(points, labels, frame=schema.WORLD, stamp_ns=stamp_ns)


def ground_truth(reference: Trajectory, *, stamp_ns: int) -> Topical:
    """The true path, moved to start at the origin of world."""
    T_first_true = geometry.inverse(reference.T_world_lidar[0])
    path = (T_first_true @ T_true_lidar for T_true_lidar in reference.T_world_lidar)
    return schema.GROUND_TRUTH, foxglove.path(path, stamp_ns=stamp_ns)


def weight_color(weight: float) -> str:
    """Green for a closure of weight 1, red for 0."""
    green = round(255 * min(max(weight, 0.0), 1.0))
    return f"#{255 - green:02x}{green:02x}30ff"


def numbers_and_words(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Metadata of a record to show on a click: numbers and texts with dotted keys, without arrays."""
    flat: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= numbers_and_words(value, f"{prefix}{key}.")
        elif isinstance(value, float):
            flat[prefix + key] = f"{value:.4g}"
        elif not isinstance(value, list):
            flat[prefix + key] = str(value)
    return flat


def words(text: str, *, stamp_ns: int, level: Any = WARNING) -> Topical:
    """A message in words, for example about a scan that was skipped."""
    return schema.LOG, Log(timestamp=timestamp(stamp_ns), level=level, message=text, name="segslam")


def _words_of(step: Step) -> Iterator[Topical]:
    """Repairs and breaks of the odometry as warnings, accepted loops as information."""
    motion = step.motion
    if motion is not None and motion.state in (MotionState.REPAIRED, MotionState.REJOINED):
        by = "" if motion.moved_m is None else f", by {motion.moved_m:.2f} m"
        yield words(f"scan {step.scan_index}: motion of the odometry repaired{by}", stamp_ns=step.stamp_ns)
    elif motion is not None and motion.state is MotionState.BROKEN:
        yield words(f"scan {step.scan_index}: break, the scans do not support the motion", stamp_ns=step.stamp_ns)
    for attempt in step.attempts:
        if isinstance(attempt.outcome, LoopClosure):
            closure, found = attempt.outcome, attempt.outcome.alignment
            probable = "" if found.probability is None else probability_text(found.probability, found.evidence) + ", "
            text = (
                f"loop from keyframe {closure.source_id} to {closure.target_id}: {probable}"
                f"overlap {found.overlap:.2f}, residual {found.rms_m:.2f} m"
            )
            yield words(text, stamp_ns=step.stamp_ns, level=INFO)
