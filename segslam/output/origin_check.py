"""Admission to a WebSocket server: any web page may connect to it, but may not read a run unless its site is a viewer.

A browser names the site of the page in the header `Origin` of its request; other programs send none. The server itself
listens on a random loopback address, and connections are passed on to it after this check.
"""

import asyncio
import logging
import secrets
import socket
import sys
from asyncio import StreamReader, StreamWriter
from contextlib import suppress
from threading import Thread
from urllib.parse import urlsplit

logger = logging.getLogger(__name__)

LOCAL = frozenset(("localhost", "127.0.0.1", "::1"))
"""Hosts of pages that come from this machine."""
VIEWER = "foxglove.dev"
HEAD_S = 5.0
"""Chosen: time for a request to arrive."""
END_S = 2.0
"""Chosen: time for the last messages to reach a slow viewer."""
BLOCK_BYTES = 2**16


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
    """Listens at an address, and passes the connections that are allowed on to another one."""

    def __init__(self, host: str, port: int, inner: tuple[str, int]) -> None:
        """Raises OSError if the address is not available; port 0 selects a free port."""
        super().__init__(name="origin check", daemon=True)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.create_server((host, port), family=family)
        self.port: int = self._socket.getsockname()[1]
        self._inner = inner
        self._loop = asyncio.new_event_loop()
        self._connections: set[asyncio.Task[None]] = set()
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
            if self._connections:
                _, late = await asyncio.wait(self._connections, timeout=END_S)
                for task in late:
                    task.cancel()

    async def _connected(self, reader: StreamReader, writer: StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            await self._pass_on(reader, writer)
        except (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError, asyncio.CancelledError):
            pass  # the viewer has gone, or never was one
        finally:
            self._connections.discard(task)
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
