"""`segslam fleet`."""

from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import ConfigOption, JsonOption, QuietOption, SetOption, announce, print_out, progress, say
from segslam.core.errors import SegslamError
from segslam.core.interrupts import when_stopped


def fleet(
    drives: Annotated[
        list[Path],
        typer.Argument(help="A list of recordings in YAML, or the recordings themselves.", metavar="LIST.yaml|DATA..."),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the fleet; what is there already is not done again.")],
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler whose workers do the work, as tcp://HOST:8786.", metavar="ADDRESS"),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Number of processes on this machine, by default one for two cores.", min=1),
    ] = None,
    same_reference: Annotated[
        bool,
        typer.Option("--same-reference", help="The true poses of all drives are in one frame: score each component."),
    ] = False,
    config: ConfigOption = None,
    settings: SetOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Map any number of drives, and join those that share places: one frame, one map, one log for each component.

    A drive that fails is named and tried again by the next call; the others go on. Call it again to add drives.

    Example: segslam fleet drives.yaml --out city
    """
    if scheduler is not None and workers is not None:
        raise SegslamError("--workers: the scheduler has workers of its own; omit one of the options")
    for path in drives:
        check_exists(path, "give a list of drives in YAML, or recordings")
    announce("fleet: reading the list", quiet=quiet)
    from segslam.core.config import load_config
    from segslam.run.fleets import drives_of, read_drives
    from segslam.run.fleets import fleet as run_fleet
    from segslam.run.fleets.orchestrate import FILE

    load_config(config, settings or [])  # reports a wrong setting before anything is mapped
    if len(drives) == 1 and drives[0].suffix.lower() in (".yaml", ".yml"):
        if config is not None:
            raise SegslamError("--config: give it for each drive in the list, as config: FILE.yaml")
        listed = read_drives(drives[0])
    else:
        listed = drives_of(drives, config=config)
    when_stopped(f"what is done is kept in {out}; call the same command again to go on")
    result = run_fleet(
        listed,
        out,
        scheduler=scheduler,
        num_workers=workers,
        same_reference=same_reference,
        settings=settings or [],
        shown=partial(_shown, quiet=quiet),
        say=partial(say, quiet=quiet),
    )
    if json:
        print_out((result.folder / FILE).read_text(encoding="utf-8").rstrip())
        return
    for number, component in enumerate(result.components):
        error = f", error {component['ate_m']:.3f} m" if "ate_m" in component else ""
        loops = f"{component.get('num_loops_between', 0)} loops between them"
        say(f"component {number}: {', '.join(component['drives'])}; {loops}{error}", quiet=quiet)
    say(f"report: {result.folder / 'report.html'}", quiet=quiet)


def _shown(items: Iterable[Any], total: int, title: str, *, quiet: bool) -> Iterator[Any]:
    return progress(items, total=total, title=title, quiet=quiet)
