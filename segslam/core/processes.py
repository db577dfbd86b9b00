"""Independent work shared among the cores of this machine, by processes that are copies of this one.

A copy (`fork`) has all objects of this process without sending them, and takes only the memory that it changes.
"""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import numpy as np

from segslam.core.memory import note_peak_with, peak_of_copy_mb

Item = TypeVar("Item")
Done = TypeVar("Done")
Progress = Callable[[Iterable[Any], int, str], Iterator[Any]]
"""Passes items on and shows progress: takes the items, their number, and a title."""
MOST = 8
"""Chosen: number of processes that share work; each other one takes some 110 MB (KITTI 00 whole)."""


def no_progress(items: Iterable[Any], total: int, title: str) -> Iterator[Any]:
    """Shows nothing."""
    yield from items


def in_parts(
    items: Sequence[Item],
    work: Callable[[Sequence[Item]], Iterable[Done]],
    *,
    progress: Progress = no_progress,
    title: str = "",
) -> Iterator[Done]:
    """The results of `work`, in order, for consecutive parts of the items: one here, the others in copies.

    A part must not depend on what the work on another one changes in memory, and `work` should return small objects.
    `progress` shows the part that is done here. All is done here where there is one core, and while other threads run:
    a copy would wait forever for a lock that they hold.
    """
    first, *others = np.array_split(np.arange(len(items)), max(1, min(_num_processes(), len(items))))
    copies: list[_Copy] = []
    try:
        copies.extend(_Copy(work, [items[row] for row in rows]) for rows in others)
        yield from progress(work([items[row] for row in first]), len(first), title)
        for copy in copies:
            yield from copy.results()
        note_peak_with(sum(copy.peak_mb for copy in copies))
    finally:
        for copy in copies:
            copy.end()


def _num_processes() -> int:
    if sys.platform != "linux" or threading.active_count() > 1:
        return 1
    return min(len(os.sched_getaffinity(0)), MOST)


class _Copy:
    """A copy of this process that does one part."""

    def __init__(self, work: Callable[[Any], Iterable[Any]], part: Sequence[Any]) -> None:
        self.peak_mb = 0.0
        """Peak of the memory that the copy needed beside that of this process, known with its results."""
        self._do = lambda: work(part)
        self._pipe, theirs = Pipe(duplex=False)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for this process, which ends all
        try:
            self._pid = _fork()
            if self._pid == 0:
                self._serve(theirs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()

    def _serve(self, pipe: Connection) -> None:
        """Send the results and end; after a failure, nothing is sent."""
        self._pipe.close()  # else this process, waiting to send, would outlive the other one
        try:
            pipe.send((list(self._do()), peak_of_copy_mb()))
        finally:
            os._exit(0)

    def results(self) -> Iterable[Any]:
        """The results; if the copy has failed or was ended, for example for lack of memory, the work is done here."""
        try:
            done, self.peak_mb = self._pipe.recv()
        except (EOFError, OSError):
            return self._do()
        return done

    def end(self) -> None:
        """End the process; results that were not received are lost."""
        self._pipe.close()
        if self._pid > 0:
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)


def _fork() -> int:
    """As `os.fork`, but -1 if the system has no room for another process."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of Python 3.12, for threads of libraries
        try:
            return os.fork()
        except OSError:
            return -1
