"""A source of live scans in a room."""

from threading import Event

import numpy as np

from segslam.core.types import BadScan, Scan
from segslam.run.live.waiting import Source, Waiting


def ring(radius_m: float) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    return np.column_stack([radius_m * np.cos(angles), radius_m * np.sin(angles), np.zeros(500)])


class NearSource(Source):
    """An unusable scan, then two with surfaces at 6 m; then it ends."""

    def __init__(self) -> None:
        super().__init__("live/near")

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Three scans."""

        def bad(index: int, stamp_ns: int) -> Scan:
            raise BadScan("empty")

        waiting.put(1, bad)
        for stamp_ns in (2, 3):
            waiting.put(stamp_ns, lambda index, stamp_ns: Scan(ring(6.0), stamp_ns, index))
        return "no more scans"
