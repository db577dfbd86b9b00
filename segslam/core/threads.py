"""Work in other threads: a pipeline of items, two calls at the same time, and the time of all by stage."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock, get_ident
from time import perf_counter
from typing import TypeVar

First = TypeVar("First")
Second = TypeVar("Second")
Item = TypeVar("Item")
Done = TypeVar("Done")
_ADDING = Lock()
"""Held while a stopwatch is changed. All share it: a stopwatch itself can be sent to another process."""


def at_once(first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """The results of two functions that run at the same time, the second in another thread."""
    with ThreadPoolExecutor(1) as thread:
        other = thread.submit(second)
        return first(), other.result()


def in_other_thread(
    items: Iterable[Item], work: Callable[[Item], Done], *, max_waiting: int
) -> Generator[Done, None, None]:
    """Apply `work` to each item in another thread; yields the results in order.

    The calling thread produces the items, up to `max_waiting` ahead of the item in work. An exception of an item or of
    `work` is raised in the order of the results. After it, after Ctrl-C, or if the caller stops early, no further item
    is started, and `items` is closed if it is a generator.
    """
    waiting: deque[Future[Done]] = deque()
    failures: list[BaseException] = []
    worker: list[int] = []

    def unless_failed(item: Item) -> Done:
        if failures:
            raise failures[0]
        try:
            return work(item)
        except BaseException as error:
            failures.append(error)
            raise

    thread = ThreadPoolExecutor(1, thread_name_prefix="beside", initializer=lambda: worker.append(get_ident()))
    try:
        for item in items:
            waiting.append(thread.submit(unless_failed, item))
            while waiting and (len(waiting) > max_waiting or waiting[0].done()):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        # If the caller forgot this generator, the garbage collector closes it in any thread, perhaps in the worker.
        thread.shutdown(wait=get_ident() not in worker, cancel_futures=True)
        if isinstance(items, Generator):
            items.close()


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
