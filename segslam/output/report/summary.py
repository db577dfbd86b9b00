"""A run in a notebook: the trajectory as a picture, and its most important figures."""

from html import escape

import matplotlib

from segslam.output.finished import FIGURES, FinishedRun
from segslam.output.report import figures
from segslam.output.report.page import number

SHOWN = ("num_scans", "length_m", "num_loops_accepted", "ate_m", "odometry_ate_m", "kiss_icp_ate_m")


def as_html(run: FinishedRun) -> str:
    """HTML with an SVG of the paths, in top view, and a table of figures."""
    with matplotlib.rc_context(figures.STYLE):
        picture = figures.draw_paths(run)
    known = [key for key in SHOWN if key in run.metrics]
    rows = "".join(f"<tr><td>{FIGURES[key]}</td><td>{number(run.metrics[key])}</td></tr>" for key in known)
    start = picture.find("<svg")
    return f"<b>{escape(str(run.folder))}</b><table>{rows}</table>{picture[max(start, 0) :]}"
