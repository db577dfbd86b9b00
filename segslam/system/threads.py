"""Work in other threads: a pipeline of items, and two calls at the same time."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

First = TypeVar("First")
Second = TypeVar("Second")
Item = TypeVar("Item")
Done = TypeVar("Done")


def at_once(first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """The results of two functions that run at the same time, the second in another thread."""
    with ThreadPoolExecutor(1) as thread:
        other = thread.submit(second)
        return first(), other.result()


def in_other_thread(items: Iterable[Item], work: Callable[[Item], Done], *, max_waiting: int) -> Iterator[Done]:
    """Apply `work` to each item in another thread; yields the results in order.

    The calling thread produces the items, up to `max_waiting` ahead of the item in work. An exception of an item or of
    `work` is raised in the order of the results. After it, after Ctrl-C, or if the caller stops early, no further item
    is started.
    """
    waiting: deque[Future[Done]] = deque()
    failures: list[BaseException] = []

    def unless_failed(item: Item) -> Done:
        if failures:
            raise failures[0]
        try:
            return work(item)
        except BaseException as error:
            failures.append(error)
            raise

    with ThreadPoolExecutor(1, thread_name_prefix="beside") as thread:
        try:
            for item in items:
                waiting.append(thread.submit(unless_failed, item))
                while waiting and (len(waiting) > max_waiting or waiting[0].done()):
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            thread.shutdown(cancel_futures=True)
