"""Warnings on standard error: the first of a kind at once, those after it as a count at the end."""

import logging
import sys
from collections import Counter


class FirstOfEachKind(logging.Handler):
    """Warnings are of one kind if the same words were filled in with other values."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._told: Counter[tuple[str, str]] = Counter()
        self._first: dict[tuple[str, str], str] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Tell of it, or count it."""
        kind = (record.name, str(record.msg))
        self._told[kind] += 1
        if kind not in self._first:
            self._first[kind] = f"{record.levelname}: {record.getMessage()}"
            print(f"segslam: {self._first[kind]}", file=sys.stderr)

    def tell_counts(self) -> None:
        """One line for each kind that came again."""
        for kind, num_told in self._told.items():
            if num_told > 1:
                print(f"segslam: {num_told - 1} more like this one: {self._first[kind]}", file=sys.stderr)
        self._told.clear()
