"""The channels of a log served live to Foxglove, by foxglove-sdk: the only importer of it."""

from threading import Lock

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from segslam.errors import SegslamError
from segslam.log import schema
from segslam.log.channels import channels
from segslam.log.drawing import map_message
from segslam.types import Labels, Points

LASTING = (schema.MAP, schema.ODOMETRY, schema.TRAJECTORY, schema.GROUND_TRUTH, schema.GRAPH, schema.RESULT)
"""Channels whose last message is sent to whoever subscribes later: they are written now and then only."""
LOOPBACK = "127.0.0.1"
MOST_MESSAGES = 128
"""Chosen: messages kept for a viewer that is slow, the newest; of clouds these are some 40 MB."""


class FoxgloveServer(ServerListener):
    """A WebSocket server; a context manager. A viewer that is slow loses messages and delays nothing."""

    def __init__(self, address: str) -> None:
        """Listen on `PORT` of loopback, or on `HOST:PORT`; port 0 is any free one.

        Raises SegslamError for another form, and where the port cannot be had.
        """
        host, port = parse_address(address)
        self._context = context = foxglove.Context()  # channels close when it goes
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
            self._server = foxglove.start_server(
                name="segslam",
                host=host,
                port=port,
                server_listener=self,
                context=context,
                message_backlog_size=MOST_MESSAGES,
            )
        except (OSError, RuntimeError) as error:
            raise SegslamError(f"--foxglove {address}: cannot listen there ({error}); name another port") from error
        self.url = f"ws://{host}:{self._server.port}"

    def send(self, topic: str, data: bytes, stamp_ns: int) -> None:
        """Hand a message of the log to whoever has subscribed to its topic."""
        if topic in LASTING:
            with self._lock:
                self._last[topic] = data, stamp_ns
        self._channels[topic].log(data, log_time=stamp_ns)

    def send_map(self, points: Points, labels: Labels, stamp_ns: int) -> None:
        """Send a map as the log has it at its end."""
        self.send(schema.MAP, map_message(points, labels, stamp_ns=stamp_ns)[1].SerializeToString(), stamp_ns)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send the last message of a lasting channel again."""
        with self._lock:
            last = self._last.get(channel.topic)
        if last is not None:
            self._channels[channel.topic].log(last[0], log_time=last[1])

    def __enter__(self) -> "FoxgloveServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()


def parse_address(address: str) -> tuple[str, int]:
    """Host and port of `PORT` or `HOST:PORT`. Raises SegslamError for anything else."""
    host, _, port = address.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise SegslamError(f"--foxglove {address}: give a port, as 8765, or an address to listen on, as 0.0.0.0:8765")
    return host.strip("[]") or LOOPBACK, int(port)
