"""The plots of a run."""

import csv
import io
from collections import defaultdict
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from segslam.core.evaluation import align_positions, false_loops, pose_errors
from segslam.core.trajectory import Poses, begun_among, parted, rows_of_same_scan, travelled_m
from segslam.core.types import Indices, MotionState, Rejected, RejectReason
from segslam.output.accuracy import aligned_by, judged_closures
from segslam.output.finished import FinishedRun

# Okabe and Ito's colours, distinguishable with any colour vision
TRUTH, CORRECTED, ODOMETRY, ALONE = "#B8B8B8", "#0072B2", "#E69F00", "#CC79A7"
ACCEPTED, OPTIMISED_AWAY, FALSE = "#009E73", "#CC79A7", "#D55E00"
REJECTED = ("#56B4E9", "#8C564B", "#7F7F7F", "#9467BD", "#BCBD22", "#17BECF", "#1F3A93")
STYLE: Any = {
    "svg.fonttype": "none",
    "font.size": 11,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "text.parse_math": False,  # names of files may contain a dollar sign
}
WIDTH_IN = 5.4
"""Text of 11 points is then 10 pixels high on a phone."""


class Line(NamedTuple):
    """A path and its style."""

    name: str
    poses: Poses
    color: str
    style: str
    width: float
    begun: Indices
    """Rows at which another drive begins."""


def true_scans(run: FinishedRun) -> tuple[Indices, Poses] | None:
    """Rows of the scans with ground truth, and their true poses; None if there are none."""
    if run.reference is None:
        return None
    rows = rows_of_same_scan(run.result.trajectory.scan_index, run.reference.scan_index)
    return (rows[:, 0], run.reference.T_world_lidar[rows[:, 1]]) if len(rows) else None


def _estimates_of(run: FinishedRun) -> list[Line]:
    """The trajectories of a run, of which the last is the corrected one."""
    alone, begun = run.result.alone, run.result.begun
    return [
        *([] if alone is None else [Line("KISS-ICP alone", alone.T_world_lidar, ALONE, ":", 1.5, begun)]),
        Line("odometry", run.result.odometry.T_world_lidar, ODOMETRY, "--", 1.5, begun),
        Line("corrected", run.result.trajectory.T_world_lidar, CORRECTED, "-", 1.2, begun),
    ]


def paths_of(run: FinishedRun) -> list[Line]:
    """The paths to draw, in the frame of the run, as all other plots and the map."""
    paths = _estimates_of(run)
    if (true := true_scans(run)) is not None:
        rows, truth = true
        T_world_truth = align_positions(truth[:, :3, 3], paths[-1].poses[rows, :3, 3])
        begun = begun_among(rows, run.result.begun)
        paths.insert(0, Line("truth", T_world_truth @ truth, TRUTH, "-", 4.0, begun))
    return paths


def draw_paths(run: FinishedRun) -> str:
    """Ground truth, odometry and corrected trajectory in top view, and their heights against travel."""
    figure = Figure(figsize=(WIDTH_IN, 6.6), layout="constrained")
    above, height = figure.subplots(2, 1, height_ratios=(3, 1))
    paths = paths_of(run)
    _plot_motions(above, run, paths[-1].poses)
    for line in paths:
        style: Any = {"color": line.color, "linewidth": line.width}
        above.plot(*parted(line.poses[:, :2, 3], line.begun).T, line.style, label=line.name, **style)
        above.plot(*line.poses[0, :2, 3], "o", color=line.color, markersize=5)
        height.plot(*_along(line.poses, line.poses[:, 2, 3], line.begun), line.style, **style)
    _finish_map(above)
    height.set(xlabel="distance travelled (m)", ylabel="height (m)")
    return svg(figure, "paths")


def draw_loops(run: FinishedRun) -> str:
    """All loop candidates on the corrected trajectory: closures as lines between their ends, rejected ones as dots."""
    figure = Figure(figsize=(WIDTH_IN, 5.6), layout="constrained")
    axes = figure.subplots()
    positions = run.result.trajectory.T_world_lidar[:, :2, 3]
    drawn = parted(positions, run.result.begun)
    axes.plot(*drawn.T, color="#BBBBBB", linewidth=1.2, zorder=1, label="trajectory")
    axes.plot(*positions[0], "o", color="#BBBBBB", markersize=5, zorder=1)
    ends = positions[run.result.keyframe_rows]
    for label, color, is_closed, pairs in _by_outcome(run):
        if not is_closed:
            axes.plot(*ends[[source for source, _ in pairs]].T, ".", color=color, markersize=7, label=label, zorder=2)
            continue
        for pair in pairs:
            axes.plot(*ends[list(pair)].T, "o-", color=color, markersize=3, linewidth=1.5)
        axes.plot([], [], "o-", color=color, label=label)
    _finish_map(axes)
    return svg(figure, "loops")


def draw_loops_over_time(run: FinishedRun) -> str:
    """All loop candidates: time of the new keyframe against that of the old one, coloured by outcome."""
    figure = Figure(figsize=(WIDTH_IN, 5.2), layout="constrained")
    axes = figure.subplots()
    time_s = (run.result.odometry.stamp_ns - run.result.odometry.stamp_ns[0]) / 1e9
    keyframe_s = time_s[run.result.keyframe_rows]
    for label, color, is_closed, pairs in _by_outcome(run):
        sources, targets = np.array(pairs).T
        marker = "o" if is_closed else "x"
        axes.plot(keyframe_s[sources], keyframe_s[targets], marker, color=color, label=label, markersize=5)
    axes.plot([0, keyframe_s[-1]], [0, keyframe_s[-1]], color=TRUTH, linewidth=1.0)
    axes.set(xlabel="time of the new keyframe (s)", ylabel="time of the old keyframe (s)")
    legend_on_top(axes, num_columns=2)
    return svg(figure, "times")


def draw_errors(run: FinishedRun) -> str | None:
    """Errors of position and height against travel, after the alignment of the ATE; None below 2 true poses."""
    if (true := true_scans(run)) is None or len(true[0]) < 2:
        return None
    rows, truth = true
    figure = Figure(figsize=(WIDTH_IN, 5.4), layout="constrained")
    whole, height = figure.subplots(2, 1, sharex=True)
    begun = begun_among(rows, run.result.begun)
    for line in _estimates_of(run):
        aligned = aligned_by(line.poses[rows], truth, "se3")
        is_repaired = line.name == "odometry" and run.result.alone is not None
        plot_error(whole, f"{line.name}{' after repairs' * is_repaired}", aligned, truth, line.color, begun)
        height.plot(*_along(truth, (aligned - truth)[:, 2, 3], begun), color=line.color, linewidth=1.4)
    whole.set(ylabel="error (m)")
    whole.set_ylim(bottom=0)
    height.set(xlabel="distance travelled (m)", ylabel="height error (m)")
    legend_on_top(whole, num_columns=1)
    return svg(figure, "errors")


def _along(poses: Poses, values: np.ndarray, begun: Indices | Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Distances travelled and values (n,), to be drawn with a gap where another drive begins."""
    return parted(travelled_m(poses, begun), begun), parted(values, begun)


def plot_error(
    axes: Axes, name: str, aligned: Poses, reference: Poses, color: str, begun: Indices | Sequence[int] = ()
) -> None:
    """Draw the position error of aligned poses against the distance travelled; drives begin at the rows `begun`."""
    error_m = pose_errors(aligned, reference).translation_m
    label = f"{name}, rms {np.sqrt(np.mean(error_m**2)):.2f} m"
    axes.plot(*_along(reference, error_m, begun), color=color, label=label, linewidth=1.4)


def draw_stages(stage_ms: dict[str, dict[str, float]]) -> str:
    """Median and 95th percentile of the time of each stage per call, longest first."""
    figure = Figure(figsize=(WIDTH_IN, 0.9 + 0.32 * len(stage_ms)), layout="constrained")
    axes = figure.subplots()
    stages = sorted(stage_ms, key=lambda stage: stage_ms[stage]["median"])
    axes.barh(stages, [stage_ms[stage]["p95"] for stage in stages], color="#CFE3F1", label="95th percentile")
    axes.barh(stages, [stage_ms[stage]["median"] for stage in stages], color=CORRECTED, height=0.45, label="median")
    axes.grid(visible=False, axis="y")
    axes.set(xlabel="time (ms)", xscale="log")  # from a keyframe's fraction of a millisecond to minutes of adjustment
    plain_powers(axes.xaxis)
    legend_on_top(axes, num_columns=2)
    return svg(figure, "stages")


def _plot_motions(axes: Axes, run: FinishedRun, T_corrected: Poses) -> None:
    """Mark motions of the odometry that were repaired, unsupported by the scans, or rejected by the optimiser."""

    def rows_of(*states: MotionState) -> list[int]:
        return [row for row, motion in enumerate(run.result.motions) if motion.state in states]

    rejected = [int(run.result.keyframe_rows[after]) for _, after in run.result.estimate.motion_weights]
    for name, color, marker, rows in (
        ("motion repaired", "#D55E00", ".", rows_of(MotionState.REPAIRED, MotionState.REJOINED)),
        ("break", "#CC0000", "x", rows_of(MotionState.BROKEN)),
        ("motion rejected", "#CC0000", "+", rejected),
    ):
        if rows:
            label = f"{name} ({len(rows)})"
            axes.plot(*T_corrected[rows, :2, 3].T, marker, color=color, markersize=7, zorder=4, label=label)


def _finish_map(axes: Axes) -> None:
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", adjustable="datalim")
    legend_on_top(axes, num_columns=2)


def _by_outcome(run: FinishedRun) -> list[tuple[str, str, bool, list[tuple[int, int]]]]:
    """Label, colour, whether it closed a loop, and the pairs (new, old keyframe) of each outcome that occurred.

    Rejected candidates come by reason, in the order of the pipeline; then closures: accepted, rejected later, false.
    """
    rejected = defaultdict[RejectReason, list[tuple[int, int]]](list)
    for attempt in run.result.attempts:
        if isinstance(attempt.outcome, Rejected):
            rejected[attempt.outcome.reason].append(attempt.candidate.pair)
    closed = [closure.pair for closure in run.result.closures()]
    false = _false_closures(run)
    off = run.result.estimate.rejected - false
    reasons = [reason for reason in RejectReason if reason in rejected]
    groups = [
        *(
            (reason.replace("_", " "), color, False, rejected[reason])
            for reason, color in zip(reasons, cycle(REJECTED), strict=False)
        ),
        ("accepted", ACCEPTED, True, [pair for pair in closed if pair not in off | false]),
        ("rejected by the optimiser", OPTIMISED_AWAY, True, [pair for pair in closed if pair in off]),
        ("false", FALSE, True, [pair for pair in closed if pair in false]),
    ]
    return [(f"{name} ({len(pairs)})", color, is_closed, pairs) for name, color, is_closed, pairs in groups if pairs]


def _false_closures(run: FinishedRun) -> set[tuple[int, int]]:
    """(source, target) of the closures that are false by the ground truth."""
    if run.reference is None:
        return set()
    closures, *measured = judged_closures(run.result, run.reference)
    return {closure.pair for closure, is_false in zip(closures, false_loops(*measured), strict=True) if is_false}


class _PlainPowers(LogFormatter):
    """Labels the ticks that the library would label, without a formula."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        label = super().__call__(x, pos)
        return f"{x:g}" if label else ""


def plain_powers(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers: `STYLE` draws no formulas."""
    axis.set_major_formatter(_PlainPowers())
    axis.set_minor_formatter(_PlainPowers(minor_thresholds=(1.0, 0.4)))
    axis.set_tick_params(which="minor", labelsize=8)  # otherwise labels of five digits overlap


def legend_on_top(axes: Axes, *, num_columns: int) -> None:
    """Draw the legend above the axes, on the left."""
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=num_columns, borderaxespad=0.2, fontsize=10)


def svg(figure: Figure, name: str) -> str:
    """The figure as SVG; equal data give equal text."""
    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def draw_fixes(folder: Path) -> str | None:
    """SVG text: fixes over the path in top view, and residuals over time; None for a run without fixes.

    Raises SegslamError for damaged files.
    """
    file = folder / "gnss.csv"
    from segslam.output.georeferenced import not_damaged, read_globe

    globe = read_globe(folder) if file.is_file() else None
    if globe is None:
        return None
    names = ("east_m", "north_m", "residual_east_m", "residual_north_m")
    with not_damaged(file), file.open(newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["residual_east_m"]]
        values = np.array([[float(row[name]) for name in names] for row in rows]).reshape(-1, len(names))
        minutes = np.array([int(row["stamp_ns"]) for row in rows], float) / 60e9
        kept = np.array([row["kept"] == "1" for row in rows], bool)
    enu_m, residual_m = values[:, :2], values[:, 2:]
    figure = Figure(figsize=(WIDTH_IN, 1.5 * WIDTH_IN), layout="constrained")
    above, over_time = figure.subplots(2, 1, height_ratios=(2, 1))
    above.plot(*globe.T_enu_lidar[:, :2, 3].T, color=CORRECTED, linewidth=1.2, label="trajectory", zorder=3)
    for chosen, color, name in ((kept, ACCEPTED, "kept"), (~kept, FALSE, "not kept")):
        style: Any = {"color": color, "markersize": 4}
        above.plot(*enu_m[chosen].T, ".", label=f"{name}: {chosen.sum()}", scalex=False, scaley=False, **style)
        distance_m = np.hypot(*residual_m[chosen].T)
        over_time.plot(minutes[chosen] - minutes.min(initial=np.inf), distance_m, ".", **style)
    above.set(xlabel="east (m)", ylabel="north (m)")
    above.set_aspect("equal", adjustable="datalim")
    figure.legend(loc="outside upper center", ncols=3)
    over_time.set(xlabel="time (minutes)", ylabel="residual (m)", yscale="log")
    plain_powers(over_time.yaxis)
    return svg(figure, "fixes")
