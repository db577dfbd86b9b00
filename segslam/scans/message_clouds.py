"""Scans from the point cloud messages of a recording."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from segslam.core.types import Points, Vector
from segslam.scans.point_cloud2 import CloudReader, stamp_ns_of


class MessageClouds:
    """Scans of a recording that gives the log time (ns) and the decoded message of each cloud."""

    def __init__(self, messages: Any) -> None:
        self._messages: Sequence[tuple[int, Any]] = messages
        self.is_sequential: bool = messages.is_sequential
        self._read = CloudReader()
        self._has_stamps = self._uses_headers()
        self.stamp_ns = 0
        """Stamp of the last scan read: that in the header, or the log time if the headers have none."""

    @property
    def intensities(self) -> Vector | None:
        """Intensities of the last scan read; None if it has none."""
        return self._read.intensities

    def __len__(self) -> int:
        return len(self._messages)

    def __getitem__(self, index: int) -> tuple[Points, Vector]:
        """Points and times of a scan. Raises what the reader raises for a damaged one."""
        log_ns, message = self._messages[index]
        cloud = self._read(message)
        self.stamp_ns = self._read.stamp_ns if self._has_stamps else log_ns
        return cloud

    def _uses_headers(self) -> bool:
        """False if the headers of the first two messages have the stamp 0: one alone may be the start of a clock."""
        stamps_ns = []
        for index in range(min(2, len(self))):
            with suppress(Exception):  # a damaged message, which is reported when its scan is read
                stamps_ns.append(stamp_ns_of(self._messages[index][1]))
        return any(stamps_ns) or not stamps_ns
