"""Usual interval of a sensor, and gaps in its stamps."""

from collections import deque
from statistics import median

LONG_GAP = 1.5
"""Chosen: there is a gap if stamps are farther apart than this many usual intervals."""
LONGEST_PREDICTED = 10.0
"""Chosen: after more intervals (1 s at 10 Hz), prediction with constant velocity is useless."""
SET_BACK_NS = 1_000_000_000
"""Chosen: the sender's clock was set back if a stamp is this much earlier than the last, as in a replay."""
SET_FORWARD_NS = 24 * 3600 * 1_000_000_000
"""Chosen: the sender's clock was set forward if a stamp is this much later than the last: no drive has such a gap."""


class Rhythm:
    """Tracks the stamps of arriving scans."""

    def __init__(self) -> None:
        self._intervals_ns: deque[int] = deque(maxlen=21)
        self._last_ns: int | None = None
        self._shift_ns = 0
        self.num_gaps = 0
        self.num_missing = 0
        """Number of missing scans, estimated from the length of the gaps."""
        self.longest_gap_s = 0.0
        self.num_clock_set = 0

    def note(self, sent_ns: int) -> int:
        """The stamp of the next scan: as sent, or shifted to follow the last one if the clock was set."""
        stamp_ns = sent_ns + self._shift_ns
        last_ns = self._last_ns
        if last_ns is not None and not last_ns - SET_BACK_NS <= stamp_ns <= last_ns + SET_FORWARD_NS:
            self._shift_ns += last_ns + self._usual_ns() - stamp_ns
            stamp_ns = sent_ns + self._shift_ns
            self.num_clock_set += 1
        if last_ns is not None and stamp_ns > last_ns:
            self._note_interval(stamp_ns - last_ns)
        self._last_ns = max(stamp_ns, last_ns or 0)
        return stamp_ns

    def intervals(self, from_ns: int, to_ns: int) -> float:
        """The time between two stamps in usual intervals: 1 if no scan is missing between them."""
        usual_ns = self._usual_ns()
        if usual_ns == 0:
            return 1.0
        gap = (to_ns - from_ns) / usual_ns
        return 1.0 if gap < LONG_GAP else min(gap, LONGEST_PREDICTED)

    def _note_interval(self, interval_ns: int) -> None:
        usual_ns = self._usual_ns()
        if usual_ns and interval_ns > LONG_GAP * usual_ns:
            self.num_gaps += 1
            self.num_missing += round(interval_ns / usual_ns) - 1
            self.longest_gap_s = max(self.longest_gap_s, interval_ns * 1e-9)
        self._intervals_ns.append(interval_ns)

    def _usual_ns(self) -> int:
        return int(median(self._intervals_ns)) if self._intervals_ns else 0
