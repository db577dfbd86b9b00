"""Live scans: their sources, and the queue of scans that wait for the odometry; a full queue drops the oldest."""

import ctypes
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Event
from time import monotonic

import numpy as np

from segslam.core.types import BadScan, Scan, Transform
from segslam.odometry.motion_model import Intervals
from segslam.scans.dataset import Cloud, make_scan

MOST_WAITING = 4
"""Chosen: at 10 Hz, waiting then adds at most 0.4 s to the latency."""
END_NS = 2**62
"""Stamps are below this one, in the year 2116: 64 bits hold them also if they are shifted."""
WAKE_S = 0.2
"""Longest time until a stop takes effect."""
SET_BACK_NS = 1_000_000_000
"""Chosen: the sender's clock was set back if a stamp is this much earlier than the last, as in a replay."""
SET_FORWARD_NS = 24 * 3600 * 1_000_000_000
"""Chosen: the sender's clock was set forward if a stamp is this much later than the last: no drive has such a gap."""


class Tally(ctypes.Structure):
    """Scans that arrived, those dropped because the queue was full, and gaps in the stamps.

    It can lie in memory shared by two processes: the counts survive the process that counts.
    """

    _fields_ = (
        ("num_arrived", ctypes.c_int64),
        ("num_dropped", ctypes.c_int64),
        ("num_gaps", ctypes.c_int64),
        ("num_missing", ctypes.c_int64),  # estimated from the length of the gaps
        ("num_clock_set", ctypes.c_int64),
        ("longest_gap_s", ctypes.c_double),
    )


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
        self.tally = tally or Tally()
        self.is_closed = False
        self.rhythm = Rhythm(self.tally)

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
            self._arrivals.append(Arrival(self.tally.num_arrived, stamp_ns, sent_ns or 0, arrived_s, read))
            self.tally.num_arrived += 1
            if len(self._arrivals) > self._most:
                self._arrivals.popleft()
                self.tally.num_dropped += 1
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


class Rhythm:
    """Tracks the stamps of arriving scans, and counts gaps."""

    def __init__(self, tally: Tally) -> None:
        self.intervals = Intervals()
        self._shift_ns = 0
        self.tally = tally

    def note(self, sent_ns: int) -> int:
        """The stamp of the next scan: as sent, or shifted to follow the last one if the clock was set."""
        stamp_ns, last_ns = sent_ns + self._shift_ns, self.intervals.last_ns
        if last_ns is not None and not last_ns - SET_BACK_NS <= stamp_ns <= last_ns + SET_FORWARD_NS:
            self._shift_ns += last_ns + round(1e9 * self.intervals.usual_s) - stamp_ns
            stamp_ns = sent_ns + self._shift_ns
            self.tally.num_clock_set += 1
        gap = self.intervals.gap(stamp_ns)
        if last_ns is not None and gap > 1.0:
            self.tally.num_gaps += 1
            self.tally.num_missing += round(gap) - 1
            self.tally.longest_gap_s = max(self.tally.longest_gap_s, (stamp_ns - last_ns) * 1e-9)
        self.intervals.note(stamp_ns)
        return stamp_ns


class Source:
    """A stream of scans; it is sent to the front process before it is opened."""

    def __init__(self, name: str, *, intensities: bool = False, vertical_angle_deg: float = 0.0) -> None:
        """`name` is for messages and logs, such as `live/scans`; the others as for `open_dataset`."""
        self.name = name
        self._has_intensities = intensities
        self._vertical_angle_deg = vertical_angle_deg

    def open(self, tell: Callable[[str], None]) -> None:
        """Start to listen; `tell` prints messages, now and later. Raises SegslamError if that is not possible."""

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Put scans as they arrive until `stopped`; returns the reason if it ended otherwise. Has its own thread."""
        raise NotImplementedError

    def publish(self, arrival: Arrival, T_odom_lidar: Transform) -> None:
        """Publish the pose of a scan to subscribers, if any; must be fast, because the next scan waits."""

    def close(self) -> None:
        """Release the resources of `open`."""

    def _scan(self, file: Path, index: int, stamp_ns: int, cloud: Cloud) -> Scan:
        """The scan of a cloud. Raises BadScan, naming `file`, if no point can be used."""
        return make_scan(
            file,
            index,
            stamp_ns,
            cloud,
            np.zeros(len(cloud.points), np.uint8),
            has_intensities=self._has_intensities,
            vertical_angle_deg=self._vertical_angle_deg,
        )
