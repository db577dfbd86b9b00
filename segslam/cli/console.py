"""What all commands share: options, progress on standard error, one JSON object on standard output."""

import json
import logging
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from time import monotonic
from typing import Annotated, Any, Literal, TypeVar

import typer

from segslam.cli.warn import FirstOfEachKind

Item = TypeVar("Item")


def _without_warnings(quiet: bool) -> bool:
    """What `--quiet` says; if it does, no warning is told from now on."""
    for handler in logging.getLogger().handlers:
        if quiet and isinstance(handler, FirstOfEachKind):
            handler.setLevel(logging.ERROR)
    return quiet


JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, nothing else.")]
QuietOption = Annotated[
    bool,
    typer.Option(
        "--quiet", "-q", callback=_without_warnings, help="Nothing on standard error but what ends the command."
    ),
]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="YAML file with the settings that differ.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="One setting, as section.key=value; may be repeated.")
]
DatasetOption = Annotated[
    str | None, typer.Option("--dataset", help="Kind of data: kitti, or a reader of kiss-icp; else found from DATA.")
]
SequenceOption = Annotated[str, typer.Option("--sequence", help="Which sequence of the data set.")]
FramesOption = Annotated[str | None, typer.Option("--frames", help="Scans A:B by number, B not included.")]
LabelsOption = Annotated[
    str,
    typer.Option(
        "--labels", help="auto (labels/ if there, else geometric), none, geometric, network:MODEL.onnx, or a folder."
    ),
]
EncodingOption = Annotated[
    Literal["raw", "learning", "learning-0"] | None,
    typer.Option("--encoding", help="Of label files whose ids cannot tell: raw, learning (0-19), learning-0 (0-18)."),
]


def print_json(values: dict[str, Any]) -> None:
    """One JSON object on standard output. Raises ValueError for NaN: a figure that is unknown is left out instead."""
    print(json.dumps(values, allow_nan=False))


def say(text: str, *, quiet: bool = False) -> None:
    """A line for the person, on standard error so that standard output stays machine-readable."""
    if not quiet:
        print(text, file=sys.stderr)


def progress(items: Iterable[Item], *, total: int, title: str, quiet: bool = False) -> Iterator[Item]:
    """The items, with a bar on a terminal, a line every ten seconds elsewhere, and nothing under `quiet`."""
    if quiet:
        yield from items
    elif sys.stderr.isatty():
        yield from _bar(items, total, title)
    else:
        yield from _lines(items, total, title)


def _bar(items: Iterable[Item], total: int, title: str) -> Iterator[Item]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn(title),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.speed:.1f}/s"),
        TimeRemainingColumn(),
    )
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
