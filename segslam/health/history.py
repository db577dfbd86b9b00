"""Results of the last checks and registrations of a drive: usual values, and whether each scan is to be registered."""

from collections import deque
from statistics import median

import numpy as np

from segslam.config import HealthConfig
from segslam.health.check import Nudge
from segslam.health.local_map import Fit
from segslam.types import MotionState

NUM_CHECKS = 9
"""Chosen: number of checks whose median correction is monitored. On real KITTI it stays below 0.06 m and 0.27 degrees;
on the courtyard and on NCLT, where KISS-ICP fails, it reaches 0.09 and 0.28 m."""
NUM_FITS, MIN_FITS = 30, 5
MIN_OVERLAPS, LEAST_SHARE = 3, 0.75
"""Chosen: smallest overlap of a check, relative to the drive's median; below it the scans are metres apart and the
correction is meaningless. On real KITTI the smallest of 178 is 0.80 of the median."""
LEAST_OVERLAP = 0.35
"""Chosen: smallest overlap of a check or a registered scan while the drive has no median yet, and of a scan registered
with a map of few scans."""

LOST_SCANS = 30
"""Chosen: number of scans after a break that are tried against the map before it (3 s at 10 Hz)."""
LEAST_SUPPORTED, SUPPORTED_SHARE = 0.15, 0.4
"""Chosen: smallest overlap where another source supports a pose; absolute, and relative to the drive's median. Between
two simulated towns it is 0.16 at a proposal of KISS-ICP, with a median of 0.96."""
NUM_INTERVALS = 21
LONG_GAP = 1.5
"""Chosen: a scan after more than this many usual intervals is checked, however near it is."""


class Intervals:
    """The usual time between scans, and gaps."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._intervals_s: deque[float] = deque(maxlen=NUM_INTERVALS)

    @property
    def usual_s(self) -> float:
        """Median of the last intervals; 0 as long as none is known."""
        return median(self._intervals_s) if self._intervals_s else 0.0

    def note(self, stamp_ns: int) -> float:
        """Time since the last scan in usual intervals; 1 if no scan is missing, or if the stamps are unknown."""
        interval_s = 0.0 if self._last_ns is None else (stamp_ns - self._last_ns) * 1e-9
        self._last_ns = stamp_ns
        if interval_s <= 0.0:
            return 1.0
        gap = interval_s / self.usual_s if self._intervals_s else 1.0
        self._intervals_s.append(interval_s)
        return gap if gap > LONG_GAP else 1.0


class History:
    """State that depends only on the checks and registrations so far, in their order."""

    def __init__(self, config: HealthConfig) -> None:
        self._config = config
        self._tolerance = config.tolerance_m, np.radians(config.tolerance_deg)
        self._checks: deque[tuple[float, float]] = deque(maxlen=NUM_CHECKS)
        """Correction of each check: metres, radians."""
        self._overlaps: deque[float] = deque(maxlen=NUM_FITS)
        self._fits: deque[Fit] = deque(maxlen=NUM_FITS)
        self._num_to_watch = 0
        self._num_repaired = 0
        """Number of registrations so far that corrected the odometry."""
        self.scans_lost = 0
        """Number of scans since the last break."""

    @property
    def is_watching(self) -> bool:
        """True if each scan is to be registered."""
        return self._num_to_watch > 0

    def note_check(self, found: Nudge | None) -> None:
        """Note a check; watch from now on if it fails, or if the median correction exceeds half the tolerance."""
        if found is None:
            self.watch()
        else:
            self.note_moved(found.moved_m, found.moved_rad, found.overlap)

    def note_moved(self, moved_m: float, moved_rad: float, overlap: float) -> None:
        """As `note_check`, from a correction and an overlap."""
        is_known = len(self._overlaps) >= MIN_OVERLAPS
        lost = overlap < (LEAST_SHARE * median(self._overlaps) if is_known else LEAST_OVERLAP)
        self._checks.append((moved_m, moved_rad))
        halves = len(self._checks) == NUM_CHECKS and any(
            median(check[k] for check in self._checks) > self._tolerance[k] / 2 for k in range(2)
        )
        if lost or halves or self._is_off(moved_m, moved_rad):
            self.watch()
        else:
            self._overlaps.append(overlap)

    def watch(self) -> None:
        """Register the next scans, the more of them the more motions were repaired, and discard the checks so far."""
        self._checks.clear()
        self._num_to_watch = self._config.watch_scans * max(self._num_repaired, 1)

    def note_registration(self, moved_m: float, moved_rad: float, fit: Fit) -> MotionState:
        """State of a registered motion, from the error of the odometry."""
        self._fits.append(fit)
        if self._is_off(moved_m, moved_rad):
            self._num_repaired += 1
            self.watch()
            return MotionState.REPAIRED
        self._num_to_watch = max(self._num_to_watch - 1, 0)
        return MotionState.REFINED

    @property
    def is_usual_known(self) -> bool:
        """True once enough scans were registered to know the usual fit of this drive."""
        return len(self._fits) >= MIN_FITS

    def is_usual(self, fit: Fit) -> bool:
        """True if a registered scan fits the map as well as is usual for this drive."""
        if not self.is_usual_known:
            return fit.overlap >= LEAST_OVERLAP
        if fit.rms_m > self._config.max_rms * median(other.rms_m for other in self._fits):
            return False
        return fit.overlap >= (LEAST_OVERLAP if fit.is_map_new else self._config.min_overlap * self._usual_overlap())

    def is_plausible(self, fit: Fit) -> bool:
        """True if a scan overlaps the map enough for a pose that another source supports."""
        if fit.is_map_new or not self.is_usual_known:
            return fit.overlap >= LEAST_SUPPORTED
        return fit.overlap >= max(LEAST_SUPPORTED, SUPPORTED_SHARE * self._usual_overlap())

    def _usual_overlap(self) -> float:
        return median(other.overlap for other in self._fits)

    def _is_off(self, moved_m: float, moved_rad: float) -> bool:
        return bool(moved_m > self._tolerance[0] or moved_rad > self._tolerance[1])
