"""Output file for MCAP's writer that contains complete parts only, also after a failure."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from segslam.core.interrupts import interrupts_wait


class Output:
    """Unbuffered stream with the methods that MCAP's writer uses: write, tell, flush.

    After a failure no data is pending. While it is open, no other process can write the file.
    """

    def __init__(self, path: Path) -> None:
        """Raises OSError if the file cannot be written, or another process writes it."""
        self._raw = path.open("a+b", buffering=0)
        fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._raw.truncate(0)
        self._raw.seek(0)

    @property
    def closed(self) -> bool:
        """True after `close`."""
        return self._raw.closed

    def write(self, data: bytes) -> int:
        """Write all data; a single write to a raw file may be partial."""
        rest = memoryview(data)
        while rest:
            rest = rest[self._raw.write(rest) :]
        return len(data)

    def read(self, offset: int, size: int) -> bytes:
        """Bytes written earlier."""
        return os.pread(self._raw.fileno(), size, offset)

    def tell(self) -> int:
        """Number of bytes written."""
        return self._raw.tell()

    def flush(self) -> None:
        """No effect: the stream is unbuffered."""

    def close(self) -> None:
        """Close the file."""
        self._raw.close()

    def sync(self) -> None:
        """Wait until all data is on the disk and survives a power failure."""
        os.fsync(self._raw.fileno())

    @contextmanager
    def whole(self) -> Iterator[None]:
        """Context manager that writes its data completely or not at all. Ctrl-C takes effect at its end.

        On any exception, such as the OSError of a full disk, the file is truncated to its previous size and closed.
        """
        size = self.tell()
        with interrupts_wait():
            try:
                yield
            except BaseException:
                self._raw.truncate(size)
                self._raw.close()
                raise


def is_being_written(path: Path) -> bool:
    """True if any process has an `Output` open on the file."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False
