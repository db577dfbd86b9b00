"""Memory allocation of the C library, and the peak memory of this process and those it started."""

import ctypes
import re
import resource
import sys
from pathlib import Path


def keep_freed_memory() -> None:
    """Let this process keep up to 256 MB of freed memory for reuse (glibc only).

    A scan needs many arrays of some megabytes. By default glibc returns their pages to the system, which clears them
    before the next use. Reading a scan of 120,000 points then takes 6 ms, with kept memory 2 ms. All commands call this
    function; programs that use the package may. It has no effect on systems other than Linux with glibc.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(-3, 32 * 2**20)  # M_MMAP_THRESHOLD of glibc's malloc.h: the largest value that it accepts
        mallopt(-1, 256 * 2**20)  # M_TRIM_THRESHOLD


def give_back() -> None:
    """Return all freed memory to the system (glibc only); no effect elsewhere."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


_together_mb = 0.0


def note_peak_of(pid: int | None) -> None:
    """Note the peak memory of another process, before it ends, for `peak_mb` (Linux only)."""
    note_peak_with(status_mb("VmHWM", pid) or 0.0)


def note_peak_with(more_mb: float) -> None:
    """Note for `peak_mb` that other processes needed so much beside this one."""
    global _together_mb
    _together_mb = max(_together_mb, _own_peak_mb() + more_mb)


def peak_of_copy_mb() -> float:
    """Peak memory of this process, a copy of another one, that the two do not share (MB, Linux only); 0 if unknown."""
    try:
        private = re.findall(r"Private_\w+:\s*(\d+) kB", Path("/proc/self/smaps_rollup").read_text(encoding="ascii"))
    except OSError:
        return 0.0
    return sum(map(int, private)) / 1024 + (status_mb("VmHWM") or 0.0) - (status_mb("VmRSS") or 0.0)


def status_mb(key: str, pid: int | str | None = "self") -> float | None:
    """A figure of the status of a process (MB), for example VmRSS or VmHWM (Linux); None if it is unknown."""
    try:
        found = re.search(rf"{key}:\s*(\d+) kB", Path(f"/proc/{pid}/status").read_text(encoding="ascii"))
    except OSError:
        return None
    return None if found is None else int(found[1]) / 1024


def peak_mb() -> float:
    """Peak memory of this process and those noted, which count until they end (MB).

    `getrusage` is of no use for the others: a new process begins with the peak of the one that started it.
    """
    return max(_own_peak_mb(), _together_mb)


def _own_peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
