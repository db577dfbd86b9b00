"""A file under MCAP's writer that holds whole parts only, whatever happens while one is written."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from segslam.system.interrupts import interrupts_wait


class Output:
    """Unbuffered stream with the methods that MCAP's writer uses: write, tell, flush.

    After a failure nothing is left to be written later. While it is open nobody else can write the file.
    """

    def __init__(self, path: Path) -> None:
        """Raises OSError if the file cannot be written, or another process does."""
        self._raw = path.open("a+b", buffering=0)
        fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._raw.truncate(0)
        self._raw.seek(0)

    @property
    def closed(self) -> bool:
        """As of any stream."""
        return self._raw.closed

    def write(self, data: bytes) -> int:
        """Write all of the data: a raw file may take less."""
        rest = memoryview(data)
        while rest:
            rest = rest[self._raw.write(rest) :]
        return len(data)

    def read(self, offset: int, size: int) -> bytes:
        """What was written there."""
        return os.pread(self._raw.fileno(), size, offset)

    def tell(self) -> int:
        """Bytes written so far."""
        return self._raw.tell()

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """As of any stream."""
        self._raw.close()

    def sync(self) -> None:
        """Wait until all is on the disk, where a power failure leaves it."""
        os.fsync(self._raw.fileno())

    @contextmanager
    def whole(self) -> Iterator[None]:
        """What is written within comes to the file whole, or not at all. Ctrl-C waits for its end.

        On any exception, such as the OSError of a full disk, the file is cut back to what was before and closed.
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
    """Whether an `Output` is open on the file, in any process."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False
