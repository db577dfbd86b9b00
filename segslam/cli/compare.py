"""`segslam compare` and `sweep`: the figures of several runs in one table."""

import shutil
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import typer

from segslam.cli.checks import check_exists, check_free, check_own, check_run
from segslam.cli.console import Terminal
from segslam.cli.options import OverwriteOption, set_option
from segslam.cli.tables import TableFiles, as_text, with_meanings
from segslam.core.errors import SegslamError, WorkFailed, counted
from segslam.core.interrupts import when_stopped

SOURCE = "replayed.txt"
"""File in the folder of a sweep: the log that its runs replay, and the time of its last change."""


def compare(
    runs: Annotated[
        list[Path], typer.Argument(help="Run folders, or their log.mcap, two or more.", metavar="RUN RUN...")
    ],
    *,
    plot: Annotated[Path | None, "Draw the trajectories and their errors to this file: .png, .svg or .pdf."] = None,
    tables: TableFiles,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Compare runs: errors, loops and speed in one table, trajectories in one figure.

    Example: segslam compare runs/00 runs/00-strict --plot both.png
    """
    for folder in runs:
        check_exists(folder, "give run folders")
    check_free([plot, tables.csv, tables.latex], overwrite=overwrite)
    terminal.announce(f"compare: reading {counted(len(runs), 'run')}")
    from segslam.output.finished import read_metrics, read_run
    from segslam.output.folder import folder_of
    from segslam.output.report.comparison import check_picture, draw_runs
    from segslam.output.words import FIGURES

    runs = [folder_of(run) for run in runs]
    names = _names(runs)
    if plot is not None:
        check_picture(plot)
        draw_runs(plot, {name: read_run(folder) for name, folder in zip(names, runs, strict=True)})
    figures = {name: read_metrics(folder) for name, folder in zip(names, runs, strict=True)}
    tables.write(figures)
    width = max(14, *(len(name) + 2 for name in figures))
    names_line = "".join(f"{name:>{width}}" for name in figures)
    text = f"{names_line}\n{with_meanings(list(figures.values()), FIGURES, width=width)}"
    terminal.table({"runs": figures, "plot": None if plot is None else str(plot)}, text)
    if plot is not None and not terminal.json:
        terminal.say(f"figure written to {plot}")


def _names(runs: list[Path]) -> list[str]:
    """The last part of each path, or the whole path if the last part is not unique."""
    if len({folder.resolve() for folder in runs}) < max(len(runs), 2):
        raise SegslamError("compare: give two or more different runs")
    short = [folder.resolve().name for folder in runs]
    return short if len(set(short)) == len(runs) else [str(folder) for folder in runs]


def sweep(
    run: Annotated[Path, "Run folder, or its log.mcap."],
    *,
    out: Annotated[Path, "Folder for the replays; what is there already is not done again."],
    settings: Annotated[
        list[str],
        set_option("Values of a setting; of several settings, all combinations are replayed.", values="A,B,C"),
    ],
    workers: Annotated[int, typer.Option(min=1, help="Number of processes on this machine.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers replay, as tcp://HOST:8786.")
    ] = None,
    tables: TableFiles,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Replay a run with every combination of some settings, and show the results in one table.

    Example: segslam sweep runs/00 --set verify.max_false_share=0.01,0.001 --out sweeps/overlap
    """
    check_run(run)
    grid = grid_of(settings)
    check_own(out, SOURCE, "*=*")
    terminal.announce(f"sweep: reading {run}")
    from segslam.output.folder import log_of, writable
    from segslam.output.log import read_log
    from segslam.run.fleets.workers import workers as started
    from segslam.run.replay import changed_config

    recorded = read_log(run)
    for changes in grid.values():  # reports a wrong setting before anything is replayed
        changed_config(recorded, settings=changes)
    with writable(out):
        out.mkdir(parents=True, exist_ok=True)
    check_free([tables.csv, tables.latex], overwrite=overwrite)  # which may be in this folder
    log, note = log_of(run), out / SOURCE
    source = f"{log.resolve()} of {log.stat().st_mtime_ns} ns\n"
    if note.is_file() and note.read_text(encoding="utf-8") != source:
        raise SegslamError(f"{out}: has replays of another log; give another folder")
    note.write_text(source, encoding="utf-8")
    when_stopped(f"what is done is kept in {out}; call the same command again to go on")
    tasks = [(str(log.resolve()), str((out / name).resolve()), changes) for name, changes in grid.items()]
    rows: dict[str, dict[str, Any]] = {name: {} for name in grid}
    failures = []
    with started(out.resolve(), number=workers, scheduler=scheduler) as (work, _):
        for number, outcome in terminal.progress(work(replay_one, tasks), len(tasks), "sweep"):
            name = list(grid)[number]
            rows[name] = outcome.value or {}
            failures += [f"{name}: {outcome.failure}"] if outcome.failure else []
    tables.write(rows)
    terminal.table({"runs": rows}, as_text(rows))
    terminal.say(f"runs in {out}")
    if failures:
        raise WorkFailed("; ".join(failures))


def grid_of(settings: Sequence[str]) -> dict[str, list[str]]:
    """Name -> settings of each combination. Raises SegslamError for a text without values, and a key given twice."""
    choices: dict[str, list[str]] = {}
    for text in settings:
        key, _, listed = text.partition("=")
        values = [value for value in listed.split(",") if value]
        if not key or not values:
            raise SegslamError(f"--set {text}: give values, as in --set verify.max_false_share=0.01,0.001")
        if key in choices:
            raise SegslamError(f"--set {key}: given twice; give all its values at once, as in --set {key}=A,B")
        choices[key] = [f"{key}={value}" for value in values]
    return {" ".join(combination): list(combination) for combination in product(*choices.values())}


def replay_one(log: str, folder: str, settings: list[str]) -> dict[str, Any]:
    """The figures of one replay, which is not done again if its folder has them; runs in a worker process."""
    from segslam.output.finished import read_metrics
    from segslam.run.replay import replay

    out = Path(folder)
    if not (out / "report.html").is_file():  # the last file that a replay writes
        shutil.rmtree(out, ignore_errors=True)
        replay(log, out, settings=settings)
    return read_metrics(out)
