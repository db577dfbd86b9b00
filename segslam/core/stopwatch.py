"""Seconds spent in the stages of a registration."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from time import perf_counter

_ADDING = Lock()
"""Held while a stopwatch is changed. All share it: a stopwatch itself can be sent to another process."""


class Stopwatch:
    """Seconds spent in each stage, summed over all calls and threads."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Context manager that adds the time within it to this stage."""
        started = perf_counter()
        try:
            yield
        finally:
            self.add(stage, perf_counter() - started)

    def add(self, stage: str, seconds: float) -> None:
        """Add a time measured elsewhere (s)."""
        with _ADDING:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
