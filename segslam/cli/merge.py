"""`segslam merge`."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.compiling import compile_kernels
from segslam.cli.console import (
    ConfigOption,
    JsonOption,
    QuietOption,
    RefineMinutesOption,
    SetOption,
    announce,
    progress,
    say,
    with_minutes,
)
from segslam.cli.ending import finish
from segslam.cli.export import WITH_MAP
from segslam.cli.overwriting import OverwriteOption, make_room
from segslam.cli.run_options import WithMapOption
from segslam.core.interrupts import EXIT_STATUS, when_stopped


def merge(
    runs: Annotated[list[Path], typer.Argument(help="Folders of finished runs, two or more.", metavar="RUN RUN...")],
    out: Annotated[Path, typer.Option(help="New folder for the merged run.")],
    same_reference: Annotated[
        bool,
        typer.Option(
            "--same-reference", help="The true poses of all runs are in one frame: score the merged trajectory."
        ),
    ] = False,
    refine_minutes: RefineMinutesOption = None,
    with_map: WithMapOption = False,
    config: ConfigOption = None,
    settings: SetOption = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Merge runs that share places into one run: one frame, one map, one log.

    The runs are registered with each other without initial guess. The world frame of the merged run is that of the
    first. A session whose stamps are not later than those of the previous session is shifted in time; scan numbers
    continue.

    Example: segslam merge runs/monday runs/friday --out runs/both
    """
    for folder in runs:
        check_exists(folder, "give the folders of finished runs")
    from segslam.core.config import load_config
    from segslam.output.folder import check_new, new_folder

    if not overwrite:
        check_new(out)
    settings = with_minutes(settings, refine_minutes)
    load_config(config, settings)  # reports a wrong setting before the logs are read
    announce(f"merge: reading {len(runs)} runs", quiet=quiet)
    from segslam.run.sessions.merge import plan, run_of
    from segslam.run.sessions.recorded import read_sessions

    sessions = read_sessions(runs)
    compile_kernels(quiet=quiet)
    settings_now = load_config(config, settings, base=sessions[0].run.config)
    merged = plan(sessions, config=settings_now, same_reference=same_reference, progress=partial(_shown, quiet=quiet))
    say(merged.summary(), quiet=quiet)
    make_room(out, overwrite=overwrite, inputs=runs)
    folder = new_folder(out)
    when_stopped(f"the log in {folder} is kept, without results")
    with run_of(merged, folder, settings_now) as run:
        interrupted = True
        with suppress(KeyboardInterrupt):
            for _ in progress(run.take(merged.steps()), total=merged.num_steps, title="merge", quiet=quiet):
                pass
            interrupted = False
        if interrupted:
            raise typer.Exit(EXIT_STATUS)
        files = [folder / name for name in WITH_MAP] if with_map else []
        finish(
            run,
            merged.reference,
            map_files=files,
            json=json,
            quiet=quiet,
            more=merged.figures,
            place=merged.georeference,
        )


def _shown(items: Iterable[Any], total: int, title: str, *, quiet: bool) -> Iterator[Any]:
    return progress(items, total=total, title=title, quiet=quiet)
