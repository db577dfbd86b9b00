"""A source of live scans that ignores the request to end."""

from threading import Event

from segslam.run.live.waiting import Source, Waiting


class HangingSource(Source):
    """Gives no scan, ignores `stopped`, and must not be closed while it hangs."""

    def __init__(self) -> None:
        super().__init__("hanging")

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Hangs, like a middleware that waits for a peer."""
        Event().wait()
        return ""

    def close(self) -> None:
        """Would hang, too."""
        Event().wait()
