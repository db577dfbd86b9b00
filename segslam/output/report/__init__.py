"""The report of a run: one HTML page with map, plots, figures and settings, without network access."""

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import matplotlib

from segslam.core.processes import in_parts
from segslam.core.whole_files import expanded, write_whole
from segslam.output.finished import FinishedRun, read_run
from segslam.output.folder import folder_of
from segslam.output.map.before_after import BeforeAfter
from segslam.output.map.from_above import small_png
from segslam.output.report import figures, loops
from segslam.output.report.page import loops_section, number, page, picture_section, section
from segslam.output.words import FIGURES

__all__ = ["BEFORE_AFTER", "draw_before_after", "write_report"]

BEFORE_AFTER = "before_after.png"

MOST_KEYFRAMES = 500
"""Chosen: in longer drives, every second keyframe is drawn, or every third, and so on; each takes about 10 ms."""


def write_report(folder: str | Path) -> Path:
    """Write `report.html` into a run folder, given it or its log, from the files there; returns its path.

    Raises SegslamError if the folder contains no finished run, or cannot be written.
    """
    folder = folder_of(expanded(folder))
    run = read_run(folder)
    drawings: list[Callable[[FinishedRun], Any]] = [_plots, _pictures]
    loops.packed_plotly()  # kept here, not in the copy that writes it: other reports may follow
    plots, (top, gallery) = in_parts(drawings, lambda part: [draw(run) for draw in part])
    about = {**run.log.run, "segslam": run.log.packages.get("segslam", "unknown version")}
    file = folder / "report.html"
    html = page(run, plots, top=top, gallery=gallery, about=about)
    write_whole(file, html.encode(errors="backslashreplace"))
    return file


def draw_before_after(folder: Path) -> bytes:
    """A PNG of the map by odometry beside the corrected map. Raises SegslamError as `write_report`."""
    return _before_after(read_run(folder)).draw()


@matplotlib.rc_context(figures.STYLE)
def _plots(run: FinishedRun) -> dict[str, str]:
    """The plots by caption, as far as the run contains the data."""
    plots = {"Trajectory, top view and height": figures.draw_paths(run)}
    if (errors := figures.draw_errors(run)) is not None:
        plots["Error along the drive, after alignment"] = errors
    if (fixes := figures.draw_fixes(run.folder)) is not None:
        plots["Position fixes, top view and residuals"] = fixes
    plots["Loops by outcome"] = figures.draw_loops(run)
    if run.result.attempts:
        plots["Loops over time"] = figures.draw_loops_over_time(run)
    stages = {stage: ms for stage, ms in run.metrics.get("stage_ms", {}).items() if stage != "finish"}
    if stages:
        plots["Time per call of each stage"] = figures.draw_stages(stages)
    return plots


def _pictures(run: FinishedRun) -> tuple[str, str]:
    """HTML with pictures of the map, and of pairs of keyframes; most need the clouds of the log."""
    before_after = _before_after(run)
    top = section("Top view", loops.top_view(run, before_after.below_ceiling))
    note = "Left: before, by odometry. Right: after, as mapped."
    top += picture_section("Map by odometry, and corrected", before_after.draw(), note=note)
    map_file = run.folder / "map.png"
    if map_file.is_file():
        top += picture_section("Map in top view", small_png(map_file))
    return top, loops_section(loops.draw(run, before_after.below_ceiling))


def _before_after(run: FinishedRun) -> BeforeAfter:
    _, cloud_of = run.log.keyframes()
    poses = run.result.odometry.T_world_lidar[run.result.keyframe_rows]
    drawn = range(0, len(poses), 1 + len(poses) // MOST_KEYFRAMES)
    return BeforeAfter(dict(enumerate(poses)), run.result.estimate, drawn, cloud_of)


SHOWN = ("num_scans", "length_m", "num_loops_accepted", "ate_m", "odometry_ate_m", "kiss_icp_ate_m")


def as_html(run: FinishedRun) -> str:
    """HTML with an SVG of the paths, in top view, and a table of figures."""
    with matplotlib.rc_context(figures.STYLE):
        picture = figures.draw_paths(run)
    known = [key for key in SHOWN if key in run.metrics]
    rows = "".join(f"<tr><td>{FIGURES[key]}</td><td>{number(run.metrics[key])}</td></tr>" for key in known)
    return f"<b>{escape(str(run.folder))}</b><table>{rows}</table>{picture[picture.index('<svg') :]}"
