"""Scans that have arrived and wait for the odometry; the oldest are dropped when there are too many."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from threading import Condition
from time import monotonic

from segslam.live.rhythm import Rhythm
from segslam.types import Scan

MOST_WAITING = 4
"""Chosen: at 10 Hz a pose is then at most 0.4 s older than by the time odometry takes for one scan."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A scan that has arrived and is not yet read."""

    index: int
    """Its number among all that arrived, those dropped later included."""
    stamp_ns: int
    """Later than that of the scan before, also where the clock of the sender was set back."""
    sent_ns: int
    """The stamp as it was sent."""
    arrived_s: float
    """By time.monotonic, which all processes of a machine share."""
    read: Callable[[int, int], Scan]
    """The scan, from its number and stamp. Raises BadScan."""


class Waiting:
    """A bounded queue between the thread that receives scans and the one that places them."""

    def __init__(self, *, most: int = MOST_WAITING) -> None:
        self._most = most
        self._arrivals: deque[Arrival] = deque()
        self._changed = Condition()
        self.is_closed = False
        self.rhythm = Rhythm()
        self.num_arrived = 0
        self.num_dropped = 0

    def put(self, sent_ns: int, read: Callable[[int, int], Scan]) -> None:
        """Add a scan; the oldest that waits is dropped if there are too many. Never waits."""
        arrived_s = monotonic()
        with self._changed:
            if self.is_closed:
                return
            stamp_ns = self.rhythm.note(sent_ns)
            self._arrivals.append(Arrival(self.num_arrived, stamp_ns, sent_ns, arrived_s, read))
            self.num_arrived += 1
            if len(self._arrivals) > self._most:
                self._arrivals.popleft()
                self.num_dropped += 1
            self._changed.notify()

    def take(self, timeout_s: float | None) -> Arrival | None:
        """The next scan; None after `timeout_s` without one, or if the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._arrivals or self.is_closed, timeout_s)
            return self._arrivals.popleft() if self._arrivals else None

    def close(self) -> None:
        """Take no more scans; those that wait are still given."""
        with self._changed:
            self.is_closed = True
            self._changed.notify()
