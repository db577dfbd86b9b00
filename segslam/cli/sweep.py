"""`segslam sweep`."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import typer

from segslam.cli import completion
from segslam.cli.checks import check_exists
from segslam.cli.console import JsonOption, QuietOption, announce, print_json, print_out, progress, say
from segslam.cli.overwriting import OverwriteOption, check_free
from segslam.cli.tables import CsvOption, LatexOption, as_text, write_tables
from segslam.core.errors import SegslamError, WorkFailed
from segslam.core.interrupts import when_stopped


def sweep(
    run: Annotated[Path, typer.Argument(help="Run folder, or its log.mcap.")],
    out: Annotated[Path, typer.Option(help="Folder for the replays; what is there already is not done again.")],
    settings: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="SECTION.KEY=A,B,C",
            autocompletion=completion.settings,
            help="Values of a setting; of several settings, all combinations are replayed.",
        ),
    ],
    workers: Annotated[int, typer.Option(min=1, help="Number of processes on this machine.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers replay, as tcp://HOST:8786.")
    ] = None,
    csv: CsvOption = None,
    latex: LatexOption = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Replay a run with every combination of some settings, and show the results in one table.

    Example: segslam sweep runs/00 --set verify.max_false_share=0.01,0.001 --out sweeps/overlap
    """
    check_exists(run, "give a run folder, or its log.mcap")
    grid = grid_of(settings)
    check_free([file for file in (csv, latex) if file], overwrite=overwrite)
    announce(f"sweep: reading {run}", quiet=quiet)
    from segslam.core.config import load_config
    from segslam.output.folder import log_of
    from segslam.output.log import read_log
    from segslam.run.fleets.workers import workers as started
    from segslam.run.replay import check_settings

    recorded = read_log(log_of(run))
    for changes in grid.values():  # reports a wrong setting before anything is replayed
        check_settings(load_config(None, changes, base=recorded.config), recorded)
    out.mkdir(parents=True, exist_ok=True)
    when_stopped(f"what is done is kept in {out}; call the same command again to go on")
    tasks = [(str(log_of(run).resolve()), str((out / name).resolve()), changes) for name, changes in grid.items()]
    rows: dict[str, dict[str, Any]] = {name: {} for name in grid}
    failures = []
    with started(out.resolve(), number=workers, scheduler=scheduler) as (work, _):
        for number, outcome in progress(work(replay_one, tasks), total=len(tasks), title="sweep", quiet=quiet):
            name = list(grid)[number]
            rows[name] = outcome.value or {}
            failures += [f"{name}: {outcome.failure}"] if outcome.failure else []
    write_tables(rows, csv_file=csv, latex_file=latex)
    if json:
        print_json({"runs": rows})
    elif not quiet:
        print_out(as_text(rows))
    say(f"runs in {out}", quiet=quiet)
    if failures:
        raise WorkFailed("; ".join(failures))


def grid_of(settings: Sequence[str]) -> dict[str, list[str]]:
    """Name -> settings of each combination. Raises SegslamError for a text without values."""
    choices = []
    for text in settings:
        key, _, values = text.partition("=")
        if not key or not values:
            raise SegslamError(f"--set {text}: give values, as in --set verify.max_false_share=0.01,0.001")
        choices.append([f"{key}={value}" for value in values.split(",") if value])
    return {" ".join(combination): list(combination) for combination in product(*choices)}


def replay_one(log: str, folder: str, settings: list[str]) -> dict[str, Any]:
    """The figures of one replay, which is not done again if its folder has them; runs in a worker process."""
    import shutil

    from segslam.output.finished import read_metrics
    from segslam.run.replay import replay

    out = Path(folder)
    if not (out / "report.html").is_file():  # the last file that a replay writes
        shutil.rmtree(out, ignore_errors=True)
        replay(log, out, settings=settings)
    return read_metrics(out)
