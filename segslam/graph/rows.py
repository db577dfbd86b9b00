"""An array that grows by rows."""

import numpy as np


class Rows:
    """Rows of one shape. Arrays returned by `all` do not change: rows are only appended."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows
        self._num = len(rows)

    def __len__(self) -> int:
        return self._num

    def append(self, row: np.ndarray | float) -> None:
        """Add a row; amortised constant time."""
        if self._num == len(self._rows):
            longer = np.empty((max(16, 2 * self._num), *self._rows.shape[1:]))
            longer[: self._num] = self._rows
            self._rows = longer
        self._rows[self._num] = row
        self._num += 1

    def all(self) -> np.ndarray:
        """A read-only view of the rows so far."""
        view = self._rows[: self._num]
        view.flags.writeable = False
        return view
