"""A run as one HTML page that needs no network: plots, figures, settings."""

from pathlib import Path

import matplotlib

from segslam.report import figures
from segslam.report.page import page
from segslam.results import FinishedRun, read_run
from segslam.types import SegslamError

__all__ = ["draw_picture", "write_report"]


def write_report(folder: Path) -> Path:
    """Draw the run of a folder from what is in it, and write `report.html` there, which is returned.

    Raises SegslamError if the folder holds no finished run, or cannot be written to.
    """
    run = read_run(folder)
    with matplotlib.rc_context(figures.STYLE):
        plots = _plots(run)
    map_file = folder / "map.png"
    pictures = {"Map from above": map_file.read_bytes()} if map_file.is_file() else {}
    return _write(folder / "report.html", page(run, plots, pictures).encode())


def draw_picture(folder: Path) -> Path:
    """The trajectory and the loops of a run as `picture.png` in its folder. Raises SegslamError as `write_report`."""
    run = read_run(folder)
    with matplotlib.rc_context(figures.STYLE):
        return _write(folder / "picture.png", figures.draw_picture(run))


def _write(file: Path, content: bytes) -> Path:
    try:
        file.write_bytes(content)
    except OSError as error:
        raise SegslamError(f"{file}: cannot be written ({error.strerror}); make room, or check permissions") from error
    return file


def _plots(run: FinishedRun) -> dict[str, str]:
    """By caption, those that the run has the data for."""
    plots = {"Trajectory from above, and its height": figures.draw_paths(run)}
    true = figures.compared(run)
    if true is not None:
        plots["Error along the drive, after alignment"] = figures.draw_errors(true)
    plots["Loops by outcome"] = figures.draw_loops(run)
    if run.metrics.get("stage_ms"):
        plots["Time of each stage, each time that it ran"] = figures.draw_stages(run.metrics["stage_ms"])
    return plots
