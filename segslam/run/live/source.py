"""Interface of all sources of live scans. A source is created in the main process and opened in the front process."""

from collections.abc import Callable
from threading import Event
from typing import Protocol, runtime_checkable

from segslam.core.types import Transform
from segslam.run.live.waiting import Arrival, Waiting


@runtime_checkable
class Source(Protocol):
    """A stream of scans; it is sent to the front process before it is opened."""

    @property
    def name(self) -> str:
        """Name for messages and logs, such as `live/scans`."""
        ...

    def open(self, tell: Callable[[str], None]) -> None:
        """Start to listen; `tell` prints messages, now and later.

        Raises SegslamError if the source is not available.
        """
        ...

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Put scans as they arrive until `stopped`; returns the reason if it ended otherwise.

        Runs in its own thread.
        """
        ...

    def publish(self, arrival: Arrival, T_odom_lidar: Transform) -> None:
        """Publish the pose of a scan to subscribers; must be fast, because the next scan waits."""
        ...

    def close(self) -> None:
        """Release the resources of `open`."""
        ...
