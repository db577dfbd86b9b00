"""A source of live scans that ignores the request to end."""

from collections.abc import Callable
from threading import Event

from segslam.core.types import Transform
from segslam.run.live.waiting import Arrival, Waiting


class HangingSource:
    """Gives no scan, ignores `stopped`, and must not be closed while it hangs."""

    name = "hanging"

    def open(self, tell: Callable[[str], None]) -> None:
        """Nothing to open."""

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Hangs, like a middleware that waits for a peer."""
        Event().wait()
        return ""

    def publish(self, arrival: Arrival, T_odom_lidar: Transform) -> None:
        """There is no subscriber."""

    def close(self) -> None:
        """Would hang, too."""
        Event().wait()
