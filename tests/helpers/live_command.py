"""`segslam live` in a process of its own, as a person runs it, and a recorder that writes scans."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np

from segslam.core.types import Scan


def _with_ctrl_c() -> None:
    """A shell starts what runs in the background with Ctrl-C ignored, which a command inherits."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


class LiveCommand:
    """The command; a context manager that leaves no process behind."""

    def __init__(self, *arguments: object, **environment: str) -> None:
        words = [sys.executable, "-m", "segslam", "live", *map(str, arguments), "--json"]
        self.output = ""
        self._process = subprocess.Popen(
            words,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | environment,
            preexec_fn=_with_ctrl_c,
        )

    def __enter__(self) -> "LiveCommand":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()

    @property
    def pid(self) -> int:
        return self._process.pid

    def wait_for(self, text: str) -> None:
        """Wait until a line with this text was printed."""
        assert self._process.stderr
        while text not in self.output:
            line = self._process.stderr.readline()
            assert line, f"ended: {self.output}"
            self.output += line

    def signal(self, number: int = signal.SIGINT) -> None:
        self._process.send_signal(number)

    def ended(self) -> tuple[int, dict[str, Any]]:
        """Exit status, and the figures, empty if there are none."""
        printed, output = self._process.communicate(timeout=120)
        self.output += output
        return self._process.returncode, json.loads(printed) if printed else {}


def write_scan(folder: Path, scan: Scan, name: str) -> None:
    """Write a scan like a recorder: under a hidden name until it is complete."""
    part = folder / f".{name}.part"
    np.column_stack([scan.points, np.linalg.norm(scan.points, axis=1)]).astype("<f4").tofile(part)
    part.rename(folder / f"{name}.bin")


def record(folder: Path, scans: list[Scan], *, every_s: float, first: int = 0) -> None:
    """Write scans at a steady rate."""
    next_s = monotonic()
    for number, scan in enumerate(scans, start=first):
        write_scan(folder, scan, f"{number:06d}")
        next_s += every_s
        sleep(max(0.0, next_s - monotonic()))
