"""What all commands share: messages, warnings and progress on standard error, results on standard output."""

import json as json_text
import logging
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Annotated, Any, TypeVar

import typer

from segslam.core.errors import WorkFailed

logger = logging.getLogger(__name__)
Item = TypeVar("Item")


class FirstOfEachKind(logging.Handler):
    """Prints the first warning of each kind and counts the others; a kind is a logger and a message template."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._counts: Counter[tuple[str, str]] = Counter()
        self._last: dict[tuple[str, str], str] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Print or count a warning."""
        kind = (record.name, str(record.msg))
        self._counts[kind] += 1
        if kind not in self._last:
            say(f"segslam: {record.levelname}: {record.getMessage()}")
        self._last[kind] = record.getMessage()

    def print_counts(self) -> None:
        """Print the number of further warnings of each kind."""
        for kind, num_warnings in self._counts.items():
            if num_warnings > 1:
                more = "1 more warning" if num_warnings == 2 else f"{num_warnings - 1} more warnings"
                say(f"segslam: {more} like this, the last: {self._last[kind]}")
        self._counts.clear()


def _without_warnings(quiet: bool) -> bool:
    """Callback of `--quiet`: disables warnings."""
    for handler in logging.getLogger().handlers:
        if quiet and isinstance(handler, FirstOfEachKind):
            handler.setLevel(logging.ERROR)
    return quiet


@dataclass(frozen=True)
class Terminal:
    """Options of nearly every command, and how it answers: results on standard output, all else on standard error."""

    json: Annotated[bool, "Print the figures as one JSON object on standard output, and nothing else there."] = False
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet",
            "-q",
            callback=_without_warnings,
            help="Print no progress and no warnings, only the error that ends the command.",
        ),
    ] = False

    def say(self, text: str) -> None:
        """Print a message, unless `--quiet` is given."""
        if not self.quiet:
            say(text)

    def announce(self, text: str) -> None:
        """Print a first message on a terminal, before libraries are imported and data is opened."""
        if sys.stderr.isatty():
            self.say(text)

    def answer(self, figures: dict[str, Any], text: str) -> None:
        """Print the figures with `--json`, otherwise the text as a message."""
        if self.json:
            print_json(figures)
        else:
            self.say(text)

    def table(self, figures: dict[str, Any], text: str) -> None:
        """Print the figures with `--json`, otherwise, unless `--quiet` is given, the text on standard output."""
        if self.json:
            print_json(figures)
        elif not self.quiet:
            print(text, flush=True)

    def progress(self, items: Iterable[Item], total: int, title: str, *, num_before: int = 0) -> Iterator[Item]:
        """Yield the items; show a bar on a terminal, or print a line every ten seconds; no output if quiet or empty.

        `num_before`: number of first items that were finished in an earlier run; the rate is that of the others.
        """
        if self.quiet or total == 0:
            yield from items
        elif sys.stderr.isatty():
            yield from _bar(items, total, title, num_before)
        else:
            yield from _lines(items, total, title, num_before)

    def compile_kernels(self) -> int:
        """Compile all kernels, with a progress bar, unless they are compiled; returns the number of compiled kernels.

        On failure, each kernel is compiled on its first call.
        """
        from segslam.core import kernels

        if kernels.are_built():
            return 0
        total = kernels.num_kernels()
        self.say("first use on this machine: compiling, once, 20 to 60 s")
        try:
            for _ in self.progress(kernels.build(), total, "compile"):
                pass
        except (RuntimeError, OSError) as error:
            logger.warning("%s; the run starts slowly", error)
        return total


def print_json(values: dict[str, Any] | list[Any]) -> None:
    """Print one JSON value on standard output. Raises ValueError for NaN: callers must omit unknown figures."""
    print(json_text.dumps(values, allow_nan=False), flush=True)


def say(text: str) -> None:
    """Print a message on standard error; standard output is reserved for results."""
    print(text, file=sys.stderr)


@contextmanager
def how_to_go_on(line: str, folder: Path) -> Iterator[None]:
    """Context manager that adds to the message of WorkFailed, for example of a full disk, how to continue.

    Nothing is added if there is nothing to continue: the folder of a run without a step is removed.
    """
    try:
        yield
    except WorkFailed as error:
        if not folder.exists():
            raise
        raise WorkFailed(f"{error}; {line}") from error


def _bar(items: Iterable[Item], total: int, title: str, num_before: int) -> Iterator[Item]:
    from rich import progress
    from rich.console import Console
    from rich.text import Text

    class Rate(progress.ProgressColumn):
        """Items per second; rich gives no estimate before the second item."""

        def render(self, task: progress.Task) -> Text:
            return Text("" if task.speed is None else f"{task.speed:.1f}/s")

    columns = (
        *(progress.TextColumn(title), progress.BarColumn(), progress.MofNCompleteColumn()),
        *(Rate(), progress.TimeRemainingColumn()),
    )
    with progress.Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(title, total=total, completed=num_before)
        for done, item in enumerate(items, start=1):
            yield item
            if done > num_before:
                bars.advance(task)
        bars.update(task, total=bars.tasks[0].completed)  # fewer than `total` were needed


def _lines(items: Iterable[Item], total: int, title: str, num_before: int) -> Iterator[Item]:
    started = last = monotonic()
    for done, item in enumerate(items, start=1):
        yield item
        now = monotonic()
        if done > num_before and (now - last >= 10 or done == total):
            rate = (done - num_before) / max(now - started, 1e-9)
            say(f"{title}: {done}/{total}, {rate:.1f}/s, {(total - done) / rate:.0f} s left")
            last = now
