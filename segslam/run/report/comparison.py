"""Figures that compare several runs, or an estimate and its reference."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from segslam.evaluation import align_positions, pose_errors
from segslam.run.finished import FinishedRun
from segslam.run.report import figures
from segslam.system.whole_files import check_target, whole_file
from segslam.trajectory import Poses, rows_of_same_scan, travelled_m
from segslam.types import SegslamError

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9")
ENDINGS = (".png", ".svg", ".pdf")


def check_picture(file: Path) -> None:
    """Raises SegslamError for a file that cannot be written, or whose extension is not that of a figure."""
    if file.suffix.lower() not in ENDINGS:
        raise SegslamError(f"{file}: unknown kind of figure; its name must end in {', '.join(ENDINGS)}")
    check_target(file)


def draw_scored(file: Path, estimate: Poses, reference: Poses) -> None:
    """Draw matched poses in top view, the estimate aligned with the reference, and the error against travel."""
    aligned = align_positions(estimate[:, :3, 3], reference[:, :3, 3]) @ estimate
    with matplotlib.rc_context(figures.STYLE):
        figure = Figure(figsize=(12.8, 6.0), layout="constrained")
        above, error = figure.subplots(1, 2)
        _plot_above(above, {"reference": reference}, figures.TRUTH, width=4.0)
        _plot_above(above, {"estimate": aligned}, COLORS[0])
        _plot_error(error, "estimate", aligned, reference, COLORS[0])
        _finish(figure, above, error, file)


def draw_runs(file: Path, runs: Mapping[str, FinishedRun]) -> None:
    """Draw the trajectories of runs in top view and, for those with ground truth, the error against travel.

    All are aligned with the ground truth of the first run that has any, otherwise with the first run, by common scans.
    """
    trajectories = {name: run.result.trajectory for name, run in runs.items()}
    truth = next((run.reference for run in runs.values() if run.reference is not None), None)
    common = truth if truth is not None else next(iter(trajectories.values()))
    with matplotlib.rc_context(figures.STYLE):
        figure = Figure(figsize=(12.8, 6.0), layout="constrained")
        above, error = figure.subplots(1, 2)
        if truth is not None:
            _plot_above(above, {"ground truth": truth.T_world_lidar}, figures.TRUTH, width=4.0)
        for (name, trajectory), color in zip(trajectories.items(), _colors(len(runs)), strict=True):
            poses = trajectory.T_world_lidar
            rows = rows_of_same_scan(trajectory.scan_index, common.scan_index)
            target = common.T_world_lidar[rows[:, 1]]
            if len(rows):
                poses = align_positions(poses[rows[:, 0], :3, 3], target[:, :3, 3]) @ poses
            _plot_above(above, {name: poses}, color)
            if len(rows):
                _plot_error(error, name, poses[rows[:, 0]], target, color)
        _finish(figure, above, error, file, error_of="error" if truth is not None else "distance from the first run")


def _colors(count: int) -> Sequence[str]:
    return [COLORS[number % len(COLORS)] for number in range(count)]


def _plot_above(axes: Axes, paths: Mapping[str, Poses], color: str, *, width: float = 1.4) -> None:
    for name, poses in paths.items():
        axes.plot(*poses[:, :2, 3].T, color=color, label=name, linewidth=width)


def _plot_error(axes: Axes, name: str, aligned: Poses, reference: Poses, color: str) -> None:
    error_m = pose_errors(aligned, reference).translation_m
    label = f"{name}, rms {np.sqrt(np.mean(error_m**2)):.2f} m"
    axes.plot(travelled_m(reference), error_m, color=color, label=label, linewidth=1.4)


def _finish(figure: Figure, above: Axes, error: Axes, file: Path, *, error_of: str = "error") -> None:
    above.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", adjustable="datalim")
    error.set(xlabel="distance travelled (m)", ylabel=f"{error_of} after alignment (m)")
    error.set_ylim(bottom=0)
    for axes in (above, error):
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, borderaxespad=0.2, fontsize=10)
    with whole_file(file) as part:
        figure.savefig(part, format=file.suffix.lower()[1:], dpi=100)
