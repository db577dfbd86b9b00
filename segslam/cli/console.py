"""Parts common to all commands: options, progress on standard error, JSON on standard output."""

import json
import logging
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Annotated, Any, Literal, TypeVar

import typer

from segslam.cli import completion
from segslam.cli.warn import FirstOfEachKind
from segslam.core.errors import WorkFailed, reason

Item = TypeVar("Item")


def _without_warnings(quiet: bool) -> bool:
    """Callback of `--quiet`: disables warnings."""
    for handler in logging.getLogger().handlers:
        if quiet and isinstance(handler, FirstOfEachKind):
            handler.setLevel(logging.ERROR)
    return quiet


JsonOption = Annotated[
    bool,
    typer.Option("--json", help="Print the figures as one JSON object on standard output, and nothing else there."),
]
QuietOption = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        callback=_without_warnings,
        help="Print no progress and no warnings, only the error that ends the command.",
    ),
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="YAML file with the settings that differ from the defaults.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        autocompletion=completion.settings,
        help="Change one setting: section.key=value; may be repeated.",
    ),
]
RefineMinutesOption = Annotated[
    float | None,
    typer.Option(
        "--refine-minutes",
        metavar="MINUTES",
        help="Time limit of the adjustment of the whole map after the loops; 60 by default, 0: no adjustment.",
    ),
]
DatasetOption = Annotated[
    str | None,
    typer.Option(
        "--dataset",
        autocompletion=completion.datasets,
        help="Kind of data: kitti, or a reader of kiss-icp; detected by default.",
    ),
]
SequenceOption = Annotated[str, typer.Option("--sequence", help="Sequence of the data set.")]
FramesOption = Annotated[
    str | None,
    typer.Option("--frames", metavar="A:B[:STEP]", help="Use scans A to B by number, B excluded; every STEP-th."),
]
LabelsOption = Annotated[
    str,
    typer.Option(
        "--labels",
        autocompletion=completion.labels_or_files,
        help="Labels: auto (labels/ if present, else geometric), none, geometric, network:MODEL.onnx, or a folder.",
    ),
]
EncodingOption = Annotated[
    Literal["raw", "learning", "learning-0"] | None,
    typer.Option(
        "--encoding",
        help="Numbering of the label files, if it cannot be detected: raw, learning (0-19), learning-0 (0-18).",
    ),
]


def with_minutes(settings: list[str] | None, refine_minutes: float | None) -> list[str]:
    """The settings of `--set`, followed by that of `--refine-minutes`."""
    minutes = [] if refine_minutes is None else [f"adjustment.max_minutes={refine_minutes}"]
    return [*(settings or ()), *minutes]


def print_json(values: dict[str, Any]) -> None:
    """Print one JSON object on standard output. Raises ValueError for NaN: callers must omit unknown figures."""
    print_out(json.dumps(values, allow_nan=False))


def print_out(text: str) -> None:
    """Print lines on standard output. Raises WorkFailed on a write error, for example a full disk."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise WorkFailed(f"standard output: cannot be written ({reason(error)}); redirect it elsewhere") from error


def say(text: str, *, quiet: bool = False) -> None:
    """Print a message on standard error; standard output is reserved for results."""
    if not quiet:
        print(text, file=sys.stderr)


@contextmanager
def how_to_go_on(line: str) -> Iterator[None]:
    """Context manager that adds to the message of WorkFailed, for example of a full disk, how to continue."""
    try:
        yield
    except WorkFailed as error:
        raise WorkFailed(f"{error}; {line}") from error


def announce(text: str, *, quiet: bool) -> None:
    """Print a first message on a terminal, before libraries are imported and data is opened."""
    if sys.stderr.isatty():
        say(text, quiet=quiet)


def progress(items: Iterable[Item], *, total: int, title: str, quiet: bool = False) -> Iterator[Item]:
    """Yield the items; show a bar on a terminal, or print a line every ten seconds; no output if `quiet`."""
    if quiet:
        yield from items
    elif sys.stderr.isatty():
        yield from _bar(items, total, title)
    else:
        yield from _lines(items, total, title)


def _bar(items: Iterable[Item], total: int, title: str) -> Iterator[Item]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        """Items per second; rich gives no estimate before the second item."""

        def render(self, task: Task) -> Text:
            return Text("" if task.speed is None else f"{task.speed:.1f}/s")

    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(title, total=total)
        for item in items:
            yield item
            bars.advance(task)


def _lines(items: Iterable[Item], total: int, title: str) -> Iterator[Item]:
    started = last = monotonic()
    for done, item in enumerate(items, start=1):
        yield item
        now = monotonic()
        if now - last >= 10 or done == total:
            rate = done / max(now - started, 1e-9)
            print(f"{title}: {done}/{total}, {rate:.1f}/s, {(total - done) / rate:.0f} s left", file=sys.stderr)
            last = now
