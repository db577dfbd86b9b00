"""Ctrl-C and SIGTERM: one message at the end of a command, and sections that neither interrupts."""

import os
import shlex
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from traceback import walk_stack
from types import FrameType
from typing import Any, ClassVar

EXIT_STATUS = 130
SIGNALS = (signal.SIGINT, signal.SIGTERM)
PATIENCE = 2
"""Number of Ctrl-C that end the command in order; the next one ends it at once. The log stays readable."""


class _State:
    times = 0
    line = ""
    unfinished: ClassVar[set[Path]] = set()


def when_stopped(line: str) -> None:
    """Set the message printed if Ctrl-C ends the command: which results exist, and how to continue."""
    _State.line = line


@contextmanager
def removed_when_stopped(path: Path) -> Iterator[None]:
    """Have an unfinished file or folder removed also where Ctrl-C ends the process at once."""
    _State.unfinished.add(path)
    try:
        yield
    finally:
        _State.unfinished.discard(path)


def stop_line() -> str:
    """The message set by `when_stopped`."""
    return f"segslam: stopped: {_State.line}"


def same_command_with(option: str) -> str:
    """The command line of this process with one more option, quoted for a shell."""
    given = sys.argv[1:]
    return shlex.join(["segslam", *given, *([] if option in given else [option])])


@contextmanager
def ctrl_c_in_order() -> Iterator[None]:
    """Within it Ctrl-C and SIGTERM raise KeyboardInterrupt; during an import they end the process at once.

    An extension module that is interrupted while it is imported raises another error, or none.
    """
    _State.times, _State.line = 0, "nothing was written"
    with _handled_by(_interrupt):
        yield


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[dict[int, Any]]:
    """Context manager that replaces the handlers of both signals; yields the handlers before.

    A signal that was ignored, as in background jobs of a script, stays ignored. Only the main thread receives signals.
    """
    is_main = threading.current_thread() is threading.main_thread()
    handlers: dict[int, Any] = {number: signal.getsignal(number) for number in SIGNALS if is_main}
    before = {number: one for number, one in handlers.items() if one is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, handler)
    try:
        yield before
    finally:
        for number, one in before.items():
            signal.signal(number, one)


def _interrupt(_: int, frame: FrameType | None) -> None:
    _State.times += 1
    is_importing = any(one.f_code.co_filename.startswith("<frozen importlib") for one, _ in walk_stack(frame))
    if _State.times > PATIENCE or is_importing:
        _remove_unfinished()
        os.write(2, f"{stop_line()}\n".encode())
        os._exit(EXIT_STATUS)
    raise KeyboardInterrupt


def _remove_unfinished() -> None:
    """Uses loaded modules only: an import may be in progress."""
    for path in tuple(_State.unfinished):
        with suppress(OSError):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


@contextmanager
def interrupts_wait() -> Iterator[list[int]]:
    """Context manager in which Ctrl-C and SIGTERM wait until the end; the yielded list receives their numbers.

    A list entry cannot be lost in a callback of a library, unlike an exception.
    """
    interrupts: list[int] = []
    with _handled_by(lambda number, _: interrupts.append(number)):
        yield interrupts
    if interrupts:
        signal.raise_signal(interrupts[0])


@contextmanager
def stopped_by_signals(stop: Callable[[], object]) -> Iterator[None]:
    """The first Ctrl-C or SIGTERM calls `stop` instead of ending the process; the next one has its usual effect."""

    def hear(_: int, __: FrameType | None) -> None:
        for number, handler in before.items():
            signal.signal(number, handler)
        stop()

    with _handled_by(hear) as before:
        yield
