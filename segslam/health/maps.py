"""The local map of a drive, and the map before a break, which later scans may fit again."""

from collections.abc import Sequence

from segslam.health.history import LOST_SCANS, History
from segslam.health.local_map import LocalMap
from segslam.health.search import FoundPose, PoseSearch, SeenScan
from segslam.refinement import LightSurface
from segslam.types import Transform

RECOVER_EVERY = 5
"""Chosen: of the scans tried after a break every fifth is registered without initial guess, 0.2 s each."""


class MapsAroundBreak:
    """The current local map, the one before a break, and the scan with which the next check compares."""

    def __init__(self, empty: LocalMap, history: History, search: PoseSearch) -> None:
        self._history = history
        self._search = search
        self.local = empty
        self.before_break: LocalMap | None = None
        """The map before a break, as long as scans are tried against it."""
        self.reference: tuple[Transform, LightSurface] | None = None
        """T_odom_lidar and surface of the last scan that was added; None before the first."""

    def add(self, T_odom_lidar: Transform, scan: SeenScan) -> None:
        """Make the scan the reference of the next check, and add it to the local map."""
        self.reference = T_odom_lidar, scan.light
        self.local.add(T_odom_lidar, scan.thinned, scan.points)

    def restart(self, T_odom_lidar: Transform, scan: SeenScan) -> None:
        """Start a new local map with this scan, and keep the map before the first of several breaks in a row."""
        if self.before_break is None:
            self.before_break, self.local = self.local, self.local.empty_copy()
            self._history.scans_lost = 0
        else:
            self.local.clear()
        self.add(T_odom_lidar, scan)

    def rejoin(self, scan: SeenScan, T_odom_guesses: Sequence[Transform]) -> FoundPose | None:
        """The pose of a scan in the map before the break, which is the local map from then on; None if not found.

        After `LOST_SCANS` scans the map before the break is discarded.
        """
        if self.before_break is None:
            return None
        self._history.scans_lost += 1
        found = self._search.near(self.before_break, scan, T_odom_guesses)
        if found is None and self._history.scans_lost % RECOVER_EVERY == 0:
            found = self._search.without_guess(self.before_break, scan, must_be_usual=True)
        if found is not None:
            self.local, self.before_break = self.before_break, None
        elif self._history.scans_lost >= LOST_SCANS:
            self.before_break = None
        return found
