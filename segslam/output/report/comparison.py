"""Figures that compare several runs, or an estimate and its reference."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from segslam.core.evaluation import Up, align_positions
from segslam.core.trajectory import Poses, begun_among, parted, rows_of_same_scan
from segslam.core.types import Indices, SegslamError
from segslam.core.whole_files import check_target, whole_file
from segslam.output.accuracy import AFTER, Align, aligned_by
from segslam.output.finished import FinishedRun
from segslam.output.report import figures

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9")
ENDINGS = (".png", ".svg", ".pdf")
ACROSS: dict[Up, list[int]] = {"z": [0, 1], "-y": [0, 2]}
"""The axes of the page by the upward axis: x to the right, and y or z ahead."""


def check_picture(file: Path) -> None:
    """Raises SegslamError for a file that cannot be written, or whose extension is not that of a figure."""
    if file.suffix.lower() not in ENDINGS:
        raise SegslamError(f"{file}: unknown kind of figure; its name must end in {', '.join(ENDINGS)}")
    check_target(file)


def draw_scored(
    file: Path,
    estimate: Poses,
    reference: Poses,
    *,
    align: Align = "se3",
    up: Up = "z",
    begun: Indices | Sequence[int] = (),
) -> None:
    """Draw matched poses in top view, aligned, and the error against travel.

    `up`: upward axis of the reference; `begun`: rows at which another drive begins.
    """
    aligned = aligned_by(estimate, reference, align)
    with matplotlib.rc_context(figures.STYLE):
        figure = Figure(figsize=(12.8, 6.0), layout="constrained")
        above, error = figure.subplots(1, 2)
        _plot_above(above, "reference", parted(reference, begun), figures.TRUTH, width=4.0, up=up)
        _plot_above(above, "estimate", parted(aligned, begun), COLORS[0], up=up)
        figures.plot_error(error, "estimate", aligned, reference, COLORS[0], begun)
        _finish(figure, [above], error, file, error_of=f"error {AFTER[align]}", up=up)


def draw_runs(file: Path, runs: Mapping[str, FinishedRun]) -> None:
    """Draw the trajectories of runs in top view and their errors against travel, a top view for each data set.

    The runs of a data set are aligned with its ground truth, or with the first of them if it has none, by common scans.
    """
    groups = by_data(runs)
    colors = dict(zip(runs, cycle(COLORS), strict=False))
    has_truth = [any(runs[name].reference is not None for name in names) for names in groups]
    with matplotlib.rc_context(figures.STYLE):
        figure = Figure(figsize=(6.4 * (len(groups) + 1), 6.0), layout="constrained")
        *above, error = figure.subplots(1, len(groups) + 1)
        for axes, names in zip(above, groups, strict=True):
            _plot_group(axes, error, {name: runs[name] for name in names}, colors)
            if len(groups) > 1:
                axes.set_title(runs[names[0]].dataset or names[0], loc="right", fontsize=10)
        compared = "error" if all(has_truth) else "distance from truth or first run"
        _finish(figure, above, error, file, error_of=f"{compared} {AFTER['se3']}")


def by_data(runs: Mapping[str, FinishedRun]) -> list[list[str]]:
    """The names of runs, grouped by the data that they have mapped."""
    groups: list[list[str]] = []
    for name, run in runs.items():
        group = next((names for names in groups if _same_data(runs[names[0]], run)), [])
        if not group:
            groups.append(group)
        group.append(name)
    return groups


def _same_data(one: FinishedRun, other: FinishedRun) -> bool:
    """True if the common scans of two runs have equal stamps, and equal ground truth, or else data sets of one name."""
    drives = one.result.trajectory, other.result.trajectory
    rows = rows_of_same_scan(drives[0].scan_index, drives[1].scan_index)
    if len(rows) == 0 or (drives[0].stamp_ns[rows[:, 0]] != drives[1].stamp_ns[rows[:, 1]]).any():
        return False
    if one.reference is None or other.reference is None:
        return one.dataset == other.dataset
    rows = rows_of_same_scan(one.reference.scan_index, other.reference.scan_index)
    truths = one.reference.T_world_lidar[rows[:, 0], :3, 3], other.reference.T_world_lidar[rows[:, 1], :3, 3]
    return len(rows) > 0 and bool(np.allclose(truths[0] - truths[0][0], truths[1] - truths[1][0], atol=0.01))


def _plot_group(above: Axes, error: Axes, runs: Mapping[str, FinishedRun], colors: Mapping[str, str]) -> None:
    first = next((run for run in runs.values() if run.reference is not None), next(iter(runs.values())))
    scans = first.result.trajectory
    common = scans if first.reference is None else first.reference
    if first.reference is not None:
        begun = begun_among(common.scan_index, scans.scan_index[first.result.begun])
        _plot_above(above, "ground truth", parted(common.T_world_lidar, begun), figures.TRUTH, width=4.0)
    for name, run in runs.items():
        poses = run.result.trajectory.T_world_lidar
        rows = rows_of_same_scan(run.result.trajectory.scan_index, common.scan_index)
        target = common.T_world_lidar[rows[:, 1]]
        if len(rows):
            poses = align_positions(poses[rows[:, 0], :3, 3], target[:, :3, 3]) @ poses
            begun = begun_among(rows[:, 0], run.result.begun)
            figures.plot_error(error, name, poses[rows[:, 0]], target, colors[name], begun)
        _plot_above(above, name, parted(poses, run.result.begun), colors[name])


def _plot_above(axes: Axes, name: str, poses: Poses, color: str, *, width: float = 1.4, up: Up = "z") -> None:
    axes.plot(*poses[:, ACROSS[up], 3].T, color=color, label=name, linewidth=width)


def _finish(figure: Figure, above: Sequence[Axes], error: Axes, file: Path, *, error_of: str, up: Up = "z") -> None:
    right, ahead = ("xyz"[axis] for axis in ACROSS[up])
    for axes in above:
        axes.set(xlabel=f"{right} (m)", ylabel=f"{ahead} (m)", aspect="equal", adjustable="datalim")
    error.set(xlabel="distance travelled (m)", ylabel=f"{error_of} (m)")
    error.set_ylim(bottom=0)
    for axes in (*above, error):
        figures.legend_on_top(axes, num_columns=2)
    with whole_file(file) as part:
        figure.savefig(part, format=file.suffix.lower()[1:], dpi=100)
