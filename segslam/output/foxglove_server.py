"""Live server of the channels of a log for Foxglove. No other module imports foxglove-sdk."""

from threading import Lock

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from segslam.core.errors import SegslamError
from segslam.core.types import Labels, Points
from segslam.output.log import schema
from segslam.output.log.drawing import map_message
from segslam.output.log.schema import channels
from segslam.output.origin_check import OriginCheck, hidden_address

LASTING = (schema.MAP, schema.ODOMETRY, schema.TRAJECTORY, schema.GROUND_TRUTH, schema.GRAPH, schema.RESULT)
"""Channels that are written rarely; their last message is sent to late subscribers."""
MOST_MESSAGES = 128
"""Chosen: number of messages kept for a slow viewer, the newest ones; about 40 MB for clouds."""


class FoxgloveServer(ServerListener):
    """A WebSocket server; a context manager. A slow viewer loses messages and does not delay the run."""

    def __init__(self, address: str) -> None:
        """Listen on `PORT` (loopback) or `HOST:PORT`; 0 is a free port. Raises SegslamError if that is not possible."""
        host, port = parse_address(address)
        self._context = context = foxglove.Context()  # its channels close with it
        self._channels = {
            channel.topic: foxglove.Channel(
                channel.topic,
                message_encoding=channel.encoding,
                schema=foxglove.Schema(name=channel.schema_name, encoding=channel.schema_encoding, data=channel.schema),
                context=context,
            )
            for channel in channels()
        }
        self._last: dict[str, tuple[bytes, int]] = {}
        self._lock = Lock()
        try:
            inner = hidden_address()
            self._server = foxglove.start_server(
                name="segslam",
                host=inner,
                port=0,
                server_listener=self,
                context=context,
                message_backlog_size=MOST_MESSAGES,
            )
            try:
                self._check = OriginCheck(host, port, (inner, self._server.port))
            except OSError:
                self._server.stop()
                raise
        except (OSError, RuntimeError) as error:
            raise SegslamError(f"--foxglove {address}: cannot listen there ({error}); give another port") from error
        shown = f"[{host}]" if ":" in host else host
        self.url = f"ws://{shown}:{self._check.port}"
        self.is_public = host != "localhost" and not host.startswith("127.") and host != "::1"
        """True if other machines can connect; there is no password."""

    def send(self, topic: str, data: bytes, stamp_ns: int) -> None:
        """Send a message of the log to the subscribers of its topic."""
        if topic in LASTING:
            with self._lock:
                self._last[topic] = data, stamp_ns
        self._channels[topic].log(data, log_time=stamp_ns)

    def send_map(self, points: Points, labels: Labels, stamp_ns: int) -> None:
        """Send a map in the format of the log's final map."""
        self.send(schema.MAP, map_message(points, labels, stamp_ns=stamp_ns)[1].SerializeToString(), stamp_ns)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send the last message of a rarely written channel to the new subscriber."""
        with self._lock:
            last = self._last.get(channel.topic)
        if last is not None:
            self._channels[channel.topic].log(last[0], log_time=last[1])

    def __enter__(self) -> "FoxgloveServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()
        self._check.close()


def parse_address(address: str) -> tuple[str, int]:
    """Host and port of `PORT` or `HOST:PORT`. Raises SegslamError for anything else."""
    host, _, port = address.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise SegslamError(f"--foxglove {address}: give a port, like 8765, or address and port, like 0.0.0.0:8765")
    return host.strip("[]") or "127.0.0.1", int(port)
