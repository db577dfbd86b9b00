"""What the front process sends to the main process, and the past from which it continues."""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from segslam.core.types import BadScan, Points, Step
from segslam.odometry import Tracked
from segslam.run.live.waiting import Waiting


class Gaps(NamedTuple):
    """Gaps in the stamps so far."""

    num_gaps: int = 0
    num_missing: int = 0
    longest_gap_s: float = 0.0
    num_clock_set: int = 0

    @classmethod
    def of(cls, waiting: Waiting) -> "Gaps":
        """Those of the scans that have arrived."""
        rhythm = waiting.rhythm
        return cls(rhythm.num_gaps, rhythm.num_missing, rhythm.longest_gap_s, rhythm.num_clock_set)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A scan with its odometry pose, or an unusable scan, and the counts so far."""

    tracked: Tracked | BadScan
    latency_s: float
    """Time from the arrival of the scan to the publication of its pose."""
    placed_s: float
    """Time of the publication, by time.monotonic."""
    num_dropped: int
    gaps: Gaps


@dataclass(frozen=True, slots=True)
class Ended:
    """End of the stream: reason and final counts."""

    why: str = ""
    """Empty if the stop was requested."""
    failed: bool = False
    died: bool = False
    """True if the process can be started again."""
    num_arrived: int = 0
    num_dropped: int = 0
    gaps: Gaps = field(default_factory=Gaps)


@dataclass(slots=True, eq=False)
class Past:
    """The scans of front processes that have ended."""

    steps: list[Step]
    """Poses and motions only."""
    clouds: deque[tuple[int, Points]]
    """Row and points of the last keyframes."""
    gaps: Gaps = field(default_factory=Gaps)
