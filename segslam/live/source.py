"""What every source of live scans offers. It is made in the process of the command and opened in the front process."""

from collections.abc import Callable
from threading import Event
from typing import Protocol, runtime_checkable

from segslam.live.waiting import Arrival, Waiting
from segslam.types import Transform


@runtime_checkable
class Source(Protocol):
    """A stream of scans. It is sent to the front process before it is opened."""

    @property
    def name(self) -> str:
        """For people and logs, such as `live/scans`."""
        ...

    def open(self, tell: Callable[[str], None]) -> None:
        """Start to listen; `tell` shows a person a line, now and later.

        Raises SegslamError if there is nothing to listen to.
        """
        ...

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Put scans as they arrive until `stopped`; why it ended, if it ended by itself. In a thread of its own."""
        ...

    def publish(self, arrival: Arrival, T_odom_lidar: Transform) -> None:
        """Tell whoever listens where a scan was taken; at once, for the next scan waits."""
        ...

    def close(self) -> None:
        """Release what `open` took."""
        ...
