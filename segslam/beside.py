"""Work in threads beside: what need not be waited for, and two things at once."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

Item = TypeVar("Item")
Done = TypeVar("Done")


def both(work: Callable[..., Done], first: tuple[Any, ...], second: tuple[Any, ...]) -> tuple[Done, Done]:
    """What `work` makes of two sets of arguments, at the same time."""
    with ThreadPoolExecutor(1) as thread:
        other = thread.submit(work, *second)
        return work(*first), other.result()


def beside(items: Iterable[Item], work: Callable[[Item], Done], *, most_waiting: int) -> Iterator[Done]:
    """What `work` makes of each item, in the order of the items.

    The items are made here, by the thread that asks, and worked on in another, one at a time: while item n is worked
    on, up to `most_waiting` more are made. What raises, the making or the work, raises here in its turn, and no work
    goes on after it, nor after Ctrl-C or an early end, but for what was being worked on.
    """
    waiting: deque[Future[Done]] = deque()
    with ThreadPoolExecutor(1, thread_name_prefix="beside") as thread:
        try:
            for item in items:
                waiting.append(thread.submit(work, item))
                while waiting and (len(waiting) > most_waiting or waiting[0].done()):
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            thread.shutdown(cancel_futures=True)
