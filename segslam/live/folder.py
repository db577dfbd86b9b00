"""A folder into which a recorder writes scans. A scan is read when its file is closed or renamed to its final name."""

import ctypes
import os
import re
import select
import struct
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from threading import Event

import numpy as np

from segslam.datasets.clouds import read_cloud, read_intensities
from segslam.datasets.scans import make_scan
from segslam.live.waiting import Arrival, Waiting
from segslam.types import BadScan, Scan, SegslamError, Transform

SUFFIXES = (".bin", ".npy", ".ply", ".pcd")
IN_CLOSE_WRITE, IN_MOVED_TO = 0x8, 0x80
IN_DELETE_SELF, IN_MOVE_SELF, IN_UNMOUNT, IN_Q_OVERFLOW = 0x400, 0x800, 0x2000, 0x4000
IN_ONLYDIR = 0x01000000
"""Constants of Linux's inotify(7)."""
EVENT = struct.Struct("iIII")
"""Watch, mask, cookie and length of the following name."""
NAMES_KEPT = 1000
"""A file that is written again is the same scan; number of names that are remembered."""
STAMP_NAME = re.compile(r"(?P<s>\d{9,10})[._-](?P<fraction>\d{1,9})|(?P<ns>\d{19})|(?P<us>\d{16})")
WAKE_S = 0.2
"""Longest time until a stop takes effect."""


class FolderSource:
    """Scans as their files appear; existing files are ignored."""

    def __init__(self, folder: Path, *, intensities: bool = False, vertical_angle_deg: float = 0.0) -> None:
        self._folder = folder.expanduser().resolve()
        self._has_intensities = intensities
        self._vertical_angle_deg = vertical_angle_deg
        self.name = f"live/{self._folder.name}"
        self._fd = -1

    def open(self, tell: Callable[[str], None]) -> None:
        """Start to watch the folder. Raises SegslamError if it cannot be watched."""
        libc = ctypes.CDLL(None, use_errno=True)
        self._fd = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        mask = IN_CLOSE_WRITE | IN_MOVED_TO | IN_DELETE_SELF | IN_MOVE_SELF | IN_ONLYDIR
        if self._fd < 0 or libc.inotify_add_watch(self._fd, os.fsencode(self._folder), mask) < 0:
            why = os.strerror(ctypes.get_errno())
            raise SegslamError(f"{self._folder}: cannot be watched ({why}); give a folder on a local disk")
        there = [entry for entry in self._folder.iterdir() if entry.suffix in SUFFIXES]
        if not there or there[0].suffix in (".ply", ".pcd"):
            import open3d  # noqa: F401  (takes seconds: now instead of at the first scan)
        if there:
            tell(f"{len(there)} scans already in {self._folder} are ignored; use segslam map for these")

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Put the scans whose files are complete, until `stopped` is set or the folder is removed."""
        seen: OrderedDict[str, None] = OrderedDict()
        while not stopped.is_set():
            if not select.select([self._fd], [], [], WAKE_S)[0]:
                continue
            for mask, name in _events(os.read(self._fd, 65536)):
                if mask & (IN_DELETE_SELF | IN_MOVE_SELF | IN_UNMOUNT):
                    return f"{self._folder} was removed"
                if mask & IN_Q_OVERFLOW:
                    return f"{self._folder}: the system lost events, because files appear faster than it can report"
                file = self._folder / name
                if file.suffix not in SUFFIXES or name.startswith(".") or name in seen:
                    continue
                seen[name] = None
                if len(seen) > NAMES_KEPT:
                    seen.popitem(last=False)
                self._put(file, waiting)
        return ""

    def publish(self, arrival: Arrival, T_odom_lidar: Transform) -> None:
        """No effect: a folder has no subscribers."""

    def close(self) -> None:
        """Stop watching."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _put(self, file: Path, waiting: Waiting) -> None:
        def read(index: int, stamp_ns: int) -> Scan:
            return self._read(file, index, stamp_ns)

        try:
            named_ns = stamp_of_name(file.stem)
            stamp_ns = file.stat().st_mtime_ns if named_ns is None else named_ns
        except OSError:  # already removed: the scan is counted, and reported when it is read
            stamp_ns = 0
        waiting.put(stamp_ns, read)

    def _read(self, file: Path, index: int, stamp_ns: int) -> Scan:
        try:
            points = read_cloud(file)
            intensities = read_intensities(file) if self._has_intensities else None
        except BadScan:
            raise
        except SegslamError as error:
            raise BadScan(str(error)) from error
        labels = np.zeros(len(points), np.uint8)
        return make_scan(
            file,
            index,
            stamp_ns,
            points,
            labels,
            intensities=intensities,
            vertical_angle_deg=self._vertical_angle_deg,
        )


def stamp_of_name(stem: str) -> int | None:
    """The stamp in a file name: seconds with a fraction, or 19 digits of ns or 16 of us since 1970; or None."""
    found = STAMP_NAME.fullmatch(stem)
    if found is None:
        return None
    if found["ns"]:
        return int(found["ns"])
    if found["us"]:
        return 1000 * int(found["us"])
    return int(found["s"]) * 1_000_000_000 + int(found["fraction"].ljust(9, "0"))


def _events(data: bytes) -> list[tuple[int, str]]:
    """Mask and file name of each event."""
    events, offset = [], 0
    while offset < len(data):
        _, mask, _, length = EVENT.unpack_from(data, offset)
        offset += EVENT.size
        events.append((mask, os.fsdecode(data[offset : offset + length].rstrip(b"\0"))))
        offset += length
    return events
