"""A folder into which a recorder writes scans. A scan is read when its file is closed or renamed to its final name."""

import ctypes
import os
import select
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from multiprocessing.sharedctypes import RawValue
from pathlib import Path
from threading import Event
from time import time_ns
from typing import Any

from segslam.core.errors import counted, unreadable
from segslam.core.types import BadScan, Scan, SegslamError
from segslam.run.live.waiting import WAKE_S, Source, Waiting
from segslam.scans.clouds import SUFFIXES, read_file
from segslam.scans.named_stamps import stamp_of_name

IN_CLOSE_WRITE, IN_MOVED_TO = 0x8, 0x80
IN_DELETE_SELF, IN_MOVE_SELF, IN_UNMOUNT, IN_Q_OVERFLOW = 0x400, 0x800, 0x2000, 0x4000
IN_ONLYDIR = 0x01000000
"""Constants of Linux's inotify(7)."""
EVENT = struct.Struct("iIII")
"""Watch, mask, cookie and length of the following name."""
NAMES_KEPT = 1000
"""Number of names whose last content is remembered: a file that is closed again without a change is the same scan."""


class FolderSource(Source):
    """Scans as their files appear; existing files are ignored. A name that is written again is another scan."""

    def __init__(self, folder: Path, **options: Any) -> None:
        """`options` as for `Source`."""
        self._folder = folder.expanduser().resolve()
        super().__init__(f"live/{self._folder.name}", **options)
        self._fd = -1
        self._has_missed = False
        self._noted_ns = RawValue("q", 0)
        """Time at which the newest file that was put has changed, at first that of `open`.

        The memory is shared with the main process, from which the next front process continues."""
        self._seen: OrderedDict[str, tuple[int, int]] = OrderedDict()
        """Name -> time of the last change (ns) and size of the files that were put."""

    def open(self, tell: Callable[[str], None]) -> None:
        """Start to watch the folder. Raises SegslamError if it cannot be watched."""
        libc = ctypes.CDLL(None, use_errno=True)
        self._fd = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        mask = IN_CLOSE_WRITE | IN_MOVED_TO | IN_DELETE_SELF | IN_MOVE_SELF | IN_ONLYDIR
        if self._fd < 0 or libc.inotify_add_watch(self._fd, os.fsencode(self._folder), mask) < 0:
            why = os.strerror(ctypes.get_errno())
            raise SegslamError(f"{self._folder}: cannot be watched ({why}); give a folder on a local disk")
        there = [entry for entry in self._folder.iterdir() if entry.suffix.lower() in SUFFIXES]
        self._has_missed = self._noted_ns.value > 0
        if there and not self._has_missed:
            tell(f"ignored: {counted(len(there), 'scan')} already in {self._folder}; use segslam map for all scans")
        self._noted_ns.value = self._noted_ns.value or time_ns()

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Put the scans whose files are complete, until `stopped` is set or the folder is removed.

        Those that appeared since the last scan put by an earlier process come first.
        """
        if self._has_missed:
            self._put_missed(waiting)
        while not stopped.is_set():
            if not select.select([self._fd], [], [], WAKE_S)[0]:
                continue
            for mask, name in _events(os.read(self._fd, 65536)):
                if mask & (IN_DELETE_SELF | IN_MOVE_SELF | IN_UNMOUNT):
                    return f"{self._folder} was removed"
                if mask & IN_Q_OVERFLOW:  # files appear faster than the system can report
                    self._put_missed(waiting)
                elif self._is_scan(self._folder / name):
                    self._put(self._folder / name, waiting)
        return ""

    def close(self) -> None:
        """Stop watching."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _is_scan(self, file: Path) -> bool:
        return file.suffix.lower() in SUFFIXES and not file.name.startswith(".")

    def _put(self, file: Path, waiting: Waiting) -> None:
        """Put the scan of a file, unless its content is that of the scan put before."""
        try:
            found = file.stat()
        except OSError as error:  # removed already
            waiting.put_unusable(f"{unreadable(file, 'scan', error)}; leave files until they are mapped")
            return
        content = found.st_mtime_ns, found.st_size
        if self._seen.get(file.name) == content:
            return
        self._seen[file.name] = content
        self._seen.move_to_end(file.name)
        if len(self._seen) > NAMES_KEPT:
            self._seen.popitem(last=False)

        named_ns = stamp_of_name(file.stem)
        self._noted_ns.value = max(self._noted_ns.value, found.st_ctime_ns)
        sent_ns = found.st_mtime_ns if named_ns is None else named_ns
        waiting.put(sent_ns, lambda index, stamp_ns: self._read(file, index, stamp_ns, content))

    def _put_missed(self, waiting: Waiting) -> None:
        """Put the scans whose files have changed since the newest one that was put, in order."""
        since_ns = self._noted_ns.value
        found: list[tuple[int, Path]] = []
        for name in os.listdir(self._folder):
            file = self._folder / name
            with suppress(OSError):  # removed meanwhile
                found.append((file.stat().st_ctime_ns, file))
        for changed_ns, file in sorted(found):
            if changed_ns > since_ns and self._is_scan(file):
                self._put(file, waiting)

    def _read(self, file: Path, index: int, stamp_ns: int, content: tuple[int, int]) -> Scan:
        """The scan of a file. Raises BadScan, also if the file has another content than when it was put."""
        try:
            cloud = replace(read_file(file), stamp_ns=stamp_of_name(file.stem))
        except SegslamError as error:
            raise BadScan(str(error)) from error
        scan = self._scan(file, index, stamp_ns, cloud)
        found = file.stat()
        if found.st_size != content[1] or found.st_mtime_ns > content[0]:
            raise BadScan(f"{file}: written again before it was read; give each scan a file of its own")
        return scan


def _events(data: bytes) -> Iterator[tuple[int, str]]:
    """Mask and file name of each event."""
    while data:
        _, mask, _, length = EVENT.unpack_from(data)
        yield mask, os.fsdecode(data[EVENT.size : EVENT.size + length].rstrip(b"\0"))
        data = data[EVENT.size + length :]
