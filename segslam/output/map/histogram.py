"""Histogram of a stream of numbers."""

import numpy as np

from segslam.core.types import Vector


class Histogram:
    """Counts numbers between fixed edges. Numbers beyond the outermost edges count in the outermost bins."""

    def __init__(self, edges: Vector) -> None:
        self._edges = edges
        self._counts = np.zeros(len(edges) - 1, np.int64)

    def add(self, values: Vector) -> None:
        """Count these numbers."""
        bins = np.searchsorted(self._edges[1:-1], values, side="right")
        self._counts += np.bincount(bins, minlength=len(self._counts))

    def span(self, low_share: float, high_share: float) -> tuple[float, float]:
        """Edges of the bins that contain two quantiles: the lower edge for `low_share`, the upper for `high_share`."""
        shares = np.cumsum(self._counts) / max(self._counts.sum(), 1)
        low, high = np.searchsorted(shares, (low_share, high_share))
        return float(self._edges[low]), float(self._edges[high + 1])
