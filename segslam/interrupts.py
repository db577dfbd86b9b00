"""Ctrl-C that waits for what is being done to be complete."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupts_wait() -> Iterator[list[int]]:
    """Ctrl-C, which only the main thread hears, takes effect at the end; until then it fills the list that is given.

    Unlike an exception from wherever the program happens to be, a list entry cannot be lost in a callback of a library.
    Where Ctrl-C was to be ignored, as in jobs that a script puts in the background, it still is.
    """
    interrupts: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is signal.SIG_IGN:
        yield interrupts
        return
    signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupts:
        signal.raise_signal(signal.SIGINT)
