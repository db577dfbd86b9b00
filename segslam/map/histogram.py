"""How the numbers of a stream are spread."""

import numpy as np

from segslam.types import Vector


class Histogram:
    """Counts numbers between fixed edges; those beyond the outermost count as within."""

    def __init__(self, edges: Vector) -> None:
        self._edges = edges
        self._counts = np.zeros(len(edges) - 1, np.int64)

    def add(self, values: Vector) -> None:
        """Count these too."""
        bins = np.searchsorted(self._edges[1:-1], values, side="right")
        self._counts += np.bincount(bins, minlength=len(self._counts))

    def span(self, low_share: float, high_share: float) -> tuple[float, float]:
        """The edge below the number that this share of all is less than, and that above the one of the other share."""
        shares = np.cumsum(self._counts) / max(self._counts.sum(), 1)
        low, high = np.searchsorted(shares, (low_share, high_share))
        return float(self._edges[low]), float(self._edges[high + 1])
