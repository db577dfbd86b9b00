"""Queue of scans that wait for the odometry; the oldest are dropped if it is full."""

import ctypes
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from threading import Condition
from time import monotonic

from segslam.core.types import BadScan, Scan
from segslam.run.live.rhythm import Rhythm

MOST_WAITING = 4
"""Chosen: at 10 Hz, waiting then adds at most 0.4 s to the latency."""
END_NS = 2**62
"""Stamps are below this one, in the year 2116: 64 bits hold them also if they are shifted."""


class Tally(ctypes.Structure):
    """Counts that can lie in memory shared by two processes: they survive the process that counts."""

    _fields_ = (("num_arrived", ctypes.c_int64), ("num_dropped", ctypes.c_int64))
    num_arrived: int
    num_dropped: int


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A scan that has arrived and is not yet read."""

    index: int
    """Number of the scan among all that arrived, including dropped ones."""
    stamp_ns: int
    """Later than the stamp of the previous scan, also if the clock of the sender was set back."""
    sent_ns: int
    """The stamp as sent."""
    arrived_s: float
    """Arrival time by time.monotonic, which all processes of a machine share."""
    read: Callable[[int, int], Scan]
    """Reads the scan, given its number and stamp. Raises BadScan."""


class Waiting:
    """A bounded queue between the thread that receives scans and the one that processes them."""

    def __init__(self, *, most: int = MOST_WAITING, tally: Tally | None = None) -> None:
        self._most = most
        self._arrivals: deque[Arrival] = deque()
        self._changed = Condition()
        self._tally = tally or Tally()
        self.is_closed = False
        self.rhythm = Rhythm()

    @property
    def num_arrived(self) -> int:
        """Number of scans that arrived."""
        return self._tally.num_arrived

    @property
    def num_dropped(self) -> int:
        """Number of scans that were dropped, because the queue was full."""
        return self._tally.num_dropped

    def put(self, sent_ns: int, read: Callable[[int, int], Scan]) -> None:
        """Add a scan; drop the oldest if the queue is full. Does not wait. Without a usable stamp it is unusable."""
        if 0 <= sent_ns < END_NS:
            self._put(sent_ns, read)
        else:
            self.put_unusable(f"a scan: its stamp {sent_ns} ns is no time between 1970 and 2116; correct the stamps")

    def put_unusable(self, why: str) -> None:
        """Add a scan that cannot be read: it is counted, and reported with this reason when its turn comes."""

        def read(index: int, stamp_ns: int) -> Scan:
            raise BadScan(why)

        self._put(None, read)

    def _put(self, sent_ns: int | None, read: Callable[[int, int], Scan]) -> None:
        arrived_s = monotonic()
        with self._changed:
            if self.is_closed:
                return
            stamp_ns = 0 if sent_ns is None else self.rhythm.note(sent_ns)
            self._arrivals.append(Arrival(self.num_arrived, stamp_ns, sent_ns or 0, arrived_s, read))
            self._tally.num_arrived += 1
            if len(self._arrivals) > self._most:
                self._arrivals.popleft()
                self._tally.num_dropped += 1
            self._changed.notify()

    def take(self, timeout_s: float | None) -> Arrival | None:
        """The next scan; None after `timeout_s` without one, or if the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._arrivals or self.is_closed, timeout_s)
            return self._arrivals.popleft() if self._arrivals else None

    def close(self) -> None:
        """Accept no more scans; waiting scans are still returned."""
        with self._changed:
            self.is_closed = True
            self._changed.notify()
