"""Commands under a pseudo-terminal, as a person runs them."""

import os
import pty
import sys


def in_terminal(*command: str) -> tuple[int, str]:
    """Exit status of a process and all that it wrote to the pseudo-terminal that it ran in."""
    written = bytearray()

    def read(terminal: int) -> bytes:
        data = os.read(terminal, 4096)
        written.extend(data)
        return data

    status = pty.spawn([sys.executable, *command], read)
    return os.waitstatus_to_exitcode(status), written.decode(errors="replace")
