"""`segslam merge` and `fleet`: several drives in one frame."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.checks import check_exists, check_own, make_folder, remove_if_empty
from segslam.cli.console import Terminal
from segslam.cli.ending import finish, is_interrupted
from segslam.cli.options import WITH_MAP, RunSettings, Settings, WithMapOption
from segslam.core.errors import SegslamError, counted
from segslam.core.interrupts import EXIT_STATUS, when_stopped


def merge(
    runs: Annotated[list[Path], typer.Argument(help="Folders of finished runs, two or more.", metavar="RUN RUN...")],
    *,
    out: Annotated[Path, "New folder for the merged run."],
    same_reference: Annotated[
        bool, "The true poses of all runs are in one frame: score the merged trajectory."
    ] = False,
    with_map: WithMapOption = False,
    changes: RunSettings,
    terminal: Terminal,
) -> None:
    """Merge runs that share places into one run: one frame, one map, one log.

    The runs are registered with each other without initial guess. The world frame of the merged run is that of the
    first. A session whose stamps are not later than those of the previous session is shifted in time; scan numbers
    continue.

    Example: segslam merge runs/monday runs/friday --out runs/both
    """
    for folder in runs:
        check_exists(folder, "give the folders of finished runs")
    from segslam.output.folder import check_new

    if not changes.overwrite:
        check_new(out)
    changes.load()  # reports a wrong setting before the logs are read
    terminal.announce(f"merge: reading {counted(len(runs), 'run')}")
    from segslam.run.replay import changed_config
    from segslam.run.sessions.merge import plan
    from segslam.run.sessions.recorded import read_sessions

    sessions = read_sessions(runs)
    settings = changed_config(
        sessions[0].run.log, file=changes.config, settings=changes.overrides(), what="a merged run"
    )
    terminal.compile_kernels()
    with ExitStack() as stack:
        folder = make_folder(out, overwrite=changes.overwrite, inputs=runs)
        stack.callback(remove_if_empty, folder)
        merged = plan(sessions, config=settings, same_reference=same_reference, progress=terminal.progress)
        terminal.say(merged.summary())
        when_stopped(f"the log in {folder} is kept, without results")
        run = stack.enter_context(merged.begun(folder, settings))
        if is_interrupted(terminal.progress(run.take(merged.steps()), merged.num_steps, "merge")):
            raise typer.Exit(EXIT_STATUS)
        files = [folder / name for name in WITH_MAP] if with_map else []
        finish(run, terminal, map_files=files, place=merged.georeference)


def fleet(
    drives: Annotated[
        list[Path],
        typer.Argument(help="A list of recordings in YAML, or the recordings themselves.", metavar="LIST.yaml|DATA..."),
    ],
    *,
    out: Annotated[Path, "Folder of the fleet; what is there already is not done again."],
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler whose workers do the work, as tcp://HOST:8786.", metavar="ADDRESS"),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Number of processes on this machine, by default one for two cores.", min=1),
    ] = None,
    same_reference: Annotated[bool, "The true poses of all drives are in one frame: score each component."] = False,
    changes: Settings,
    terminal: Terminal,
) -> None:
    """Map any number of drives, and join those that share places: one frame, one map, one log for each component.

    A drive that fails is named and tried again by the next call; the others go on. Call it again to add drives.

    Example: segslam fleet drives.yaml --out city
    """
    if scheduler is not None and workers is not None:
        raise SegslamError("--workers: the scheduler has workers of its own; omit one of the options")
    for path in drives:
        check_exists(path, "give a list of drives in YAML, or recordings")
    check_own(out, "runs")
    terminal.announce("fleet: reading the list")
    from segslam.run.fleets.drives import drives_of
    from segslam.run.fleets.orchestrate import FILE
    from segslam.run.fleets.orchestrate import fleet as run_fleet

    changes.load()  # reports a wrong setting before anything is mapped
    lists = [path for path in drives if path.suffix.lower() in (".yaml", ".yml")]
    if lists and len(drives) > 1:
        raise SegslamError(f"{lists[0]}: a list of drives; give it alone, with all drives in it")
    if lists and changes.config is not None:
        raise SegslamError("--config: give it for each drive in the list, as config: FILE.yaml")
    when_stopped(f"what is done is kept in {out}; call the same command again to go on")
    result = run_fleet(
        lists[0] if lists else drives_of(drives, config=changes.config),
        out,
        scheduler=scheduler,
        num_workers=workers,
        same_reference=same_reference,
        settings=changes.overrides(),
        shown=terminal.progress,
        say=terminal.say,
    )
    if terminal.json:
        print((result.folder / FILE).read_text(encoding="utf-8").rstrip(), flush=True)
        return
    for number, component in enumerate(result.components):
        facts = [", ".join(component["drives"])]
        if len(component["drives"]) > 1:
            facts.append(f"{counted(component.get('num_loops_between', 0), 'loop')} between them")
        facts += [f"error {component['ate_m']:.3f} m"] if "ate_m" in component else []
        terminal.say(f"component {number}: {'; '.join(facts)}")
    terminal.say(f"report: {out / 'report.html'} (open it in a browser)")
