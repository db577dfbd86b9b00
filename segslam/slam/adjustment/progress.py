"""Progress of a long stage, shown by the caller."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

Progress = Callable[[Iterable[Any], int, str], Iterator[Any]]
"""Passes items on and shows progress: takes the items, their number, and a title."""


def no_progress(items: Iterable[Any], total: int, title: str) -> Iterator[Any]:
    """Shows nothing."""
    yield from items
