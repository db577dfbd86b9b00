"""Live server of the channels of a log for Foxglove. No other module imports foxglove-sdk.

Any web page may connect to a WebSocket server, but none may read a run unless its site is a viewer. A browser names the
site of the page in the header `Origin` of its request; other programs send none. The server itself listens on a random
loopback address, and connections are passed on to it after this check.
"""

import asyncio
import logging
import secrets
import socket
import sys
from asyncio import StreamReader, StreamWriter
from contextlib import suppress
from threading import Lock, Thread
from urllib.parse import urlsplit

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from segslam.core.errors import SegslamError
from segslam.core.types import Labels, Points
from segslam.output.log import schema
from segslam.output.log.drawing import map_message
from segslam.output.log.schema import channels

logger = logging.getLogger(__name__)

LASTING = (schema.MAP, schema.ODOMETRY, schema.TRAJECTORY, schema.GROUND_TRUTH, schema.GRAPH, schema.RESULT)
"""Channels that are written rarely; their last message is sent to late subscribers."""
MOST_MESSAGES = 128
"""Chosen: number of messages kept for a slow viewer, the newest ones; about 40 MB for clouds."""
LOCAL = frozenset(("localhost", "127.0.0.1", "::1"))
"""Hosts of pages that come from this machine."""
VIEWER = "foxglove.dev"
HEAD_S = 5.0
"""Chosen: time for a request to arrive."""
END_S = 2.0
"""Chosen: time for the last messages to reach a slow viewer."""
BLOCK_BYTES = 2**16


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
            listener = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
            inner = hidden_address()
            self._server = foxglove.start_server(
                name="segslam",
                host=inner,
                port=0,
                server_listener=self,
                context=context,
                message_backlog_size=MOST_MESSAGES,
            )
        except (OSError, RuntimeError) as error:
            raise SegslamError(f"--foxglove {address}: cannot listen there ({error}); give another port") from error
        self._check = OriginCheck(listener, (inner, self._server.port))
        shown = f"[{host}]" if ":" in host else host
        self.url = f"ws://{shown}:{listener.getsockname()[1]}"
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


def is_allowed(origin: str) -> bool:
    """True for Foxglove's own site, pages of this machine, and programs; not for other sites, nor hidden ones."""
    try:
        parts = urlsplit(origin)
        host = parts.hostname or ""
    except ValueError:
        return False
    if parts.scheme not in ("http", "https"):
        return parts.scheme != ""  # `null` hides a site; a program has a scheme of its own, such as file
    return host in LOCAL or (parts.scheme == "https" and (host == VIEWER or host.endswith(f".{VIEWER}")))


def hidden_address() -> str:
    """A loopback address that a web page cannot guess; on systems with a single one, that one."""
    if sys.platform != "linux":
        return "127.0.0.1"
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


class OriginCheck(Thread):
    """Serves a listening socket: passes the connections that are allowed on to another address."""

    def __init__(self, listener: socket.socket, inner: tuple[str, int]) -> None:
        super().__init__(name="origin check", daemon=True)
        self._socket = listener
        self._inner = inner
        self._loop = asyncio.new_event_loop()
        self._is_closing = asyncio.Event()
        self.start()

    def run(self) -> None:
        """Serve until `close`."""
        with suppress(OSError):
            self._loop.run_until_complete(self._serve())
        self._loop.close()

    def close(self) -> None:
        """Accept no more connections; those to a server that has ended are closed after their last messages."""
        with suppress(RuntimeError):  # closed before
            self._loop.call_soon_threadsafe(self._is_closing.set)
        self.join()

    async def _serve(self) -> None:
        async with await asyncio.start_server(self._connected, sock=self._socket, limit=BLOCK_BYTES):
            await self._is_closing.wait()
            if connections := asyncio.all_tasks() - {asyncio.current_task()}:
                _, late = await asyncio.wait(connections, timeout=END_S)
                for task in late:
                    task.cancel()

    async def _connected(self, reader: StreamReader, writer: StreamWriter) -> None:
        try:
            await self._pass_on(reader, writer)
        except (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError, asyncio.CancelledError):
            writer.transport.abort()  # the viewer has gone, or never was one, or reads no more: nothing is sent to it
        finally:
            writer.close()

    async def _pass_on(self, reader: StreamReader, writer: StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S)
        refused = [origin for origin in _origins(head) if not is_allowed(origin)]
        if refused:
            logger.warning("Foxglove: a web page of %s was refused", ascii(refused[0])[:80])
            writer.write(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            await writer.drain()
            return
        inner_reader, inner_writer = await asyncio.open_connection(*self._inner, limit=BLOCK_BYTES)
        inner_writer.write(head)
        asked = asyncio.create_task(_copy(reader, inner_writer))
        try:
            await _copy(inner_reader, writer)
        finally:
            asked.cancel()
            inner_writer.close()


def _origins(head: bytes) -> list[str]:
    """The values of the header `Origin`."""
    lines = (line.partition(b":") for line in head.split(b"\r\n")[1:])
    return [value.decode("latin-1").strip() for name, _, value in lines if name.strip().lower() == b"origin"]


async def _copy(reader: StreamReader, writer: StreamWriter) -> None:
    """Copy until the end; a slow receiver slows the sender."""
    with suppress(OSError):
        while data := await reader.read(BLOCK_BYTES):
            writer.write(data)
            await writer.drain()
        writer.close()
