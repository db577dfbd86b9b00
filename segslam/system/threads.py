"""Work in other threads: a pipeline of items, and two calls at the same time."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

Item = TypeVar("Item")
Done = TypeVar("Done")


def both(work: Callable[..., Done], first: tuple[Any, ...], second: tuple[Any, ...]) -> tuple[Done, Done]:
    """The results of `work` for two sets of arguments, computed at the same time."""
    with ThreadPoolExecutor(1) as thread:
        other = thread.submit(work, *second)
        return work(*first), other.result()


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
