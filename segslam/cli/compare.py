"""`segslam compare`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import JsonOption, QuietOption, announce, print_json, print_out, say
from segslam.cli.overwriting import OverwriteOption, check_free
from segslam.cli.tables import CsvOption, LatexOption, figure, write_tables
from segslam.core.errors import SegslamError

COLUMN = 14
"""Smallest width of a column of the table, in characters."""


def compare(
    runs: Annotated[list[Path], typer.Argument(help="Run folders, two or more.", metavar="RUN RUN...")],
    plot: Annotated[
        Path | None, typer.Option(help="Draw the trajectories and their errors to this file: .png, .svg or .pdf.")
    ] = None,
    csv: CsvOption = None,
    latex: LatexOption = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Compare runs: errors, loops and speed in one table, trajectories in one figure.

    Example: segslam compare runs/00 runs/00-strict --plot both.png
    """
    for folder in runs:
        check_exists(folder, "give run folders")
    names = _names(runs)
    check_free([file for file in (plot, csv, latex) if file], overwrite=overwrite)
    announce(f"compare: reading {len(runs)} runs", quiet=quiet)
    from segslam.output.finished import read_metrics, read_run
    from segslam.output.report.comparison import check_picture, draw_runs

    if plot is not None:
        check_picture(plot)
        draw_runs(plot, {name: read_run(folder) for name, folder in zip(names, runs, strict=True)})
    figures = {name: read_metrics(folder) for name, folder in zip(names, runs, strict=True)}
    write_tables(figures, csv_file=csv, latex_file=latex)
    if json:
        print_json({"runs": figures, "plot": None if plot is None else str(plot)})
        return
    print_out(table(figures))
    if plot is not None:
        say(f"figure written to {plot}", quiet=quiet)


def _names(runs: list[Path]) -> list[str]:
    """The last part of each path, or the whole path if the last part is not unique."""
    if len({folder.resolve() for folder in runs}) < max(len(runs), 2):
        raise SegslamError("compare: give two or more different runs")
    short = [folder.resolve().name for folder in runs]
    return short if len(set(short)) == len(runs) else [str(folder) for folder in runs]


def table(figures: dict[str, dict[str, Any]]) -> str:
    """A line for each figure of any run, and a column for each run; `-` for missing figures."""
    from segslam.output.finished import FIGURES

    width = max(COLUMN, *(len(name) + 2 for name in figures))
    lines = ["".join(f"{name:>{width}}" for name in figures)]
    for key, meaning in FIGURES.items():
        values = [run.get(key) for run in figures.values()]
        if any(value is not None for value in values):
            cells = ("-" if value is None else figure(value) for value in values)
            lines.append("".join(f"{cell:>{width}}" for cell in cells) + f"  {meaning}")
    return "\n".join(lines)
