"""Display of a run in the Rerun viewer: trajectory, clouds, loops coloured by outcome, times and memory."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from segslam.core import geometry
from segslam.core.types import (
    BadScan,
    GraphEstimate,
    Keyframe,
    Label,
    LoopAttempt,
    Motion,
    MotionState,
    Rejected,
    Step,
    Transform,
)
from segslam.labels.encodings import COLORS
from segslam.output.log.drawing import ACCEPTED_COLOR, PATH_GROWTH, REJECTED_COLORS, VIEW_EVERY

WORLD, LIDAR, TIMES = "world", "world/lidar", "stage_ms"
CORRECTED_COLOR, ODOMETRY_COLOR, MOVING_COLOR = "#00a0ff", "#ff9000", "#ff2a2a"
STAGE_COLORS = {
    "odometry": "#ff9000",
    "label": "#9bcf6a",
    "keyframe": "#3fa9f5",
    "propose": "#9a9a9a",
    "prepare": "#b07cf0",
    "match": "#f2d03b",
    "refine": "#43c6a0",
    "verify": "#e85a9b",
    "optimize": "#ff4f3f",
}
"""Fixed colours, because automatic ones may be similar."""
MOTION_COLORS = {
    MotionState.REPAIRED: "#D55E00",
    MotionState.REJOINED: "#D55E00",
    MotionState.BROKEN: "#CC0000",
}
"""Colours of the scans whose motions are marked; others are not."""


class Scene:
    """Displays a run step by step in the viewer."""

    def __init__(self, viewer: rr.RecordingStream) -> None:
        self._viewer = viewer
        self._T_odom_keyframe: list[Transform] = []
        self._T_world_keyframe: list[Transform] = []
        self._T_world_odom = np.eye(4)
        self._num_on_paths = 0
        viewer.send_blueprint(_layout())
        viewer.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        classes = [
            rr.AnnotationInfo(label, label.name.lower(), _rgb(COLORS.get(label, MOVING_COLOR))) for label in Label
        ]
        viewer.log(WORLD, rr.AnnotationContext(classes), static=True)
        for stage, color in STAGE_COLORS.items():
            viewer.log(f"{TIMES}/{stage}", rr.SeriesLines(colors=[_rgb(color)], names=[stage]), static=True)

    def add(self, step: Step | BadScan) -> None:
        """Show a step; bad scans are not shown."""
        if isinstance(step, BadScan):
            return
        self._viewer.set_time("scan", sequence=step.scan_index)
        self._viewer.set_time("data", timestamp=np.datetime64(step.stamp_ns, "ns"))
        if step.keyframe is not None:
            self._add_keyframe(step.keyframe)
        if step.estimate is not None:
            self._correct(step.estimate)
        if step.motion is not None and step.motion.state in MOTION_COLORS:
            self._add_motion(step, step.motion)
        self._viewer.log(LIDAR, _pose(self._T_world_odom @ step.T_odom_lidar), rr.TransformAxes3D(3.0))
        for attempt in step.attempts:
            self._add_attempt(attempt)
        for stage, seconds in step.stage_seconds.items():
            self._viewer.log(f"{TIMES}/{stage}", rr.Scalars(1000 * seconds))

    def end(self) -> None:
        """Draw the final paths, and wait until the viewer has all data. Raises RuntimeError after a timeout."""
        self._draw_paths()
        self._viewer.flush(timeout_sec=60.0)
        self._viewer.disconnect()

    def _draw_paths(self) -> None:
        """Draw the paths of odometry and estimate through the keyframes so far."""
        self._num_on_paths = len(self._T_odom_keyframe)
        for name, poses, color in (
            ("trajectory", self._T_world_keyframe, CORRECTED_COLOR),
            ("odometry", self._T_odom_keyframe, ODOMETRY_COLOR),
        ):
            positions = [T_world_keyframe[:3, 3] for T_world_keyframe in poses]
            self._viewer.log(f"{WORLD}/{name}", rr.LineStrips3D([positions], colors=[_rgb(color)]))

    def _add_keyframe(self, keyframe: Keyframe) -> None:
        entity = f"{WORLD}/keyframes/{keyframe.id}"
        self._T_odom_keyframe.append(keyframe.T_odom_keyframe)
        self._T_world_keyframe.append(self._T_world_odom @ keyframe.T_odom_keyframe)
        some = slice(None, None, VIEW_EVERY)
        self._viewer.log(entity, rr.Points3D(keyframe.points[some], class_ids=keyframe.labels[some], radii=0.05))
        self._viewer.log(entity, _pose(self._T_world_keyframe[-1]))
        if len(self._T_odom_keyframe) >= PATH_GROWTH * self._num_on_paths:
            self._draw_paths()

    def _add_motion(self, step: Step, motion: Motion) -> None:
        """Mark the scan after a motion that was repaired or is a guess, in the frame of the last keyframe."""
        moved = (
            "" if motion.moved_m is None else f", by {motion.moved_m:.2f} m and {motion.moved_deg or 0.0:.1f} degrees"
        )
        T_keyframe_lidar = geometry.inverse(self._T_odom_keyframe[-1]) @ step.T_odom_lidar
        mark = rr.Points3D(
            [T_keyframe_lidar[:3, 3]],
            colors=[_rgb(MOTION_COLORS[motion.state])],
            radii=0.4,
            labels=[f"{motion.state}{moved}"],
            show_labels=False,
        )
        self._viewer.log(f"{WORLD}/keyframes/{len(self._T_odom_keyframe) - 1}/motions/{step.scan_index}", mark)

    def _correct(self, estimate: GraphEstimate) -> None:
        """Move the clouds to the current poses of their keyframes, and mark motions that the optimiser rejected."""
        for keyframe_id, T_world_keyframe in estimate.T_world_keyframe.items():
            self._T_world_keyframe[keyframe_id] = T_world_keyframe
            self._viewer.log(f"{WORLD}/keyframes/{keyframe_id}", _pose(T_world_keyframe))
        self._T_world_odom = self._T_world_keyframe[-1] @ geometry.inverse(self._T_odom_keyframe[-1])
        ends = [[self._T_world_keyframe[number][:3, 3] for number in pair] for pair in estimate.motion_weights]
        color = _rgb(MOTION_COLORS[MotionState.BROKEN])
        self._viewer.log(f"{WORLD}/motions_rejected", rr.LineStrips3D(ends, colors=[color] * len(ends)))
        self._draw_paths()

    def _add_attempt(self, attempt: LoopAttempt) -> None:
        outcome, (source, target) = attempt.outcome, attempt.candidate.pair
        kind, color, shown = "accepted", ACCEPTED_COLOR, "accepted"
        if isinstance(outcome, Rejected):
            kind, color, shown = "rejected", REJECTED_COLORS[outcome.reason], f"{outcome.reason}: {outcome.detail}"
        else:  # it may have waited for confirmation
            self._viewer.log(f"{WORLD}/loops/rejected/{source}-{target}", rr.Clear(recursive=False))
        ends = [self._T_world_keyframe[number][:3, 3] for number in (source, target)]
        line = rr.LineStrips3D([ends], colors=[_rgb(color)], labels=[shown], show_labels=False)
        self._viewer.log(f"{WORLD}/loops/{kind}/{source}-{target}", line)


def _layout() -> rrb.Blueprint:
    """The world above, the time of each stage below, of the last 300 scans."""
    now = rrb.TimeRangeBoundary.cursor_relative(seq=0)
    lately = rrb.VisibleTimeRange("scan", start=rrb.TimeRangeBoundary.cursor_relative(seq=-300), end=now)
    world = rrb.Spatial3DView(origin=WORLD, name="world")
    times = rrb.TimeSeriesView(origin=TIMES, name="milliseconds by stage", time_ranges=[lately])
    return rrb.Blueprint(rrb.Vertical(world, times, row_shares=[4, 1]), collapse_panels=True)


def _pose(T_world_child: Transform) -> rr.Transform3D:
    return rr.Transform3D(translation=T_world_child[:3, 3], mat3x3=T_world_child[:3, :3])


def _rgb(color: str) -> list[int]:
    return list(bytes.fromhex(color[1:7]))
