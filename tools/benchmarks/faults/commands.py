"""Commands that run beside the benchmark, their processes, and a disk that becomes full."""

import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from time import monotonic, sleep
from typing import Any

LIMIT_S = 300.0
"""Chosen: time after which a command hangs."""
KILLS = (signal.SIGKILL, signal.SIGSEGV)
SMALLEST_KB, LARGEST_KB, ROOM_KB = 60, 110, 65536
"""Sizes of a disk that becomes full during a run of 36 scans, and of the same one with room again."""


class Command:
    """A segslam command, its output read as it comes."""

    def __init__(self, *words: object) -> None:
        self.name = words[0]
        command = [sys.executable, "-m", "segslam", *map(str, words)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.lines: list[str] = []
        self._reader = Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr
        with self.process.stderr as lines:
            for line in lines:
                self.lines.append(line.rstrip())

    def wait_for(self, text: str) -> bool:
        """Wait until a line has this text; False if the command ends before."""
        seen, end = len(self.lines), monotonic() + LIMIT_S
        while monotonic() < end:
            if any(text in line for line in self.lines[max(0, seen - 2) :]):
                return True
            if self.process.poll() is not None:
                return False
            sleep(0.05)
        return False

    def ended(self) -> tuple[int, dict[str, Any]]:
        """Exit status and figures; a command that hangs is killed, with status -999."""
        assert self.process.stdout
        try:
            status = self.process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.stdout.close()
            return -999, {}
        self._reader.join(5)
        with self.process.stdout as output:
            printed = output.read()
        return status, json.loads(printed) if printed else {}

    @property
    def has_traceback(self) -> bool:
        """True if an exception was not reported in words."""
        return any("Traceback" in line for line in self.lines)


def kill(pid: int, victim: str, rng: random.Random) -> None:
    """Kill a command (`main`), the process that it spawned (`front`), or that of KISS-ICP (`odometry`).

    A process that is being started again is waited for; if none comes, nothing is killed.
    """
    end = monotonic() + LIMIT_S
    while len(pids := _with_spawned(pid)) < 2 and victim != "main":
        if monotonic() > end:
            return
        sleep(0.05)
    chosen = {"main": 0, "front": 1, "odometry": -1}[victim]
    os.kill(pids[chosen], rng.choice(KILLS))


def _with_spawned(pid: int) -> list[int]:
    """A process, the one that it spawned, and so on."""
    pids = [pid]
    while children := _spawned(pids[-1]):
        pids.append(children[0])
    return pids


def _spawned(pid: int) -> list[int]:
    """The processes of multiprocessing that a process has started, in any of its threads."""
    try:
        children = " ".join(file.read_text() for file in Path(f"/proc/{pid}/task").glob("*/children")).split()
        return [int(child) for child in children if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()]
    except OSError:
        return []


@contextmanager
def small_disk(at: Path, rng: random.Random) -> Iterator[Any]:
    """A small file system in memory, and a function that enlarges it; None where none may be mounted."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={rng.randrange(SMALLEST_KB, LARGEST_KB)}k", "tmpfs", str(at)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode:
        yield None
        return
    try:
        yield lambda: subprocess.run(["mount", "-o", f"remount,size={ROOM_KB}k", str(at)], check=True)
    finally:
        subprocess.run(["umount", str(at)], check=False)
