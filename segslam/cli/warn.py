"""Warnings on standard error: the first of each kind at once, the number of the others at the end."""

import logging
import sys
from collections import Counter


class FirstOfEachKind(logging.Handler):
    """Prints the first warning of each kind and counts the others; a kind is a logger and a message template."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._counts: Counter[tuple[str, str]] = Counter()
        self._first: dict[tuple[str, str], str] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Print or count a warning."""
        kind = (record.name, str(record.msg))
        self._counts[kind] += 1
        if kind not in self._first:
            self._first[kind] = f"{record.levelname}: {record.getMessage()}"
            print(f"segslam: {self._first[kind]}", file=sys.stderr)

    def print_counts(self) -> None:
        """Print the number of further warnings of each kind."""
        for kind, num_warnings in self._counts.items():
            if num_warnings > 1:
                print(f"segslam: {num_warnings - 1} more warnings like this: {self._first[kind]}", file=sys.stderr)
        self._counts.clear()
