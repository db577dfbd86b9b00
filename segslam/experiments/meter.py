"""What a piece of work takes: seconds, and the memory it needed beyond what the process held before."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

PROCESS = Path("/proc/self")
RESET_PEAK = "5"
"""Written to `clear_refs`, sets the peak back to what is held now (Linux, proc(5))."""


@dataclass(slots=True)
class Cost:
    """Filled in when the work is done."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """CPU time of all threads; more reliable than `seconds` on a busy machine."""
    peak_mb: float | None = None
    """None if the system does not report it. Invalid while other threads of the process work."""


@contextmanager
def measured() -> Iterator[Cost]:
    """The cost of what is done inside."""
    cost = Cost()
    _give_back()
    before_mb = _memory_mb("VmRSS") if _reset_peak() else None
    started, cpu_started = perf_counter(), process_time()
    yield cost
    cost.seconds, cost.cpu_seconds = perf_counter() - started, process_time() - cpu_started
    if before_mb is not None:
        cost.peak_mb = max(_memory_mb("VmHWM") - before_mb, 0.0)


def _give_back() -> None:
    """Let the allocator return what is free: memory used again would not show."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's alone
    if trim is not None:
        trim(0)


def _reset_peak() -> bool:
    try:
        (PROCESS / "clear_refs").write_text(RESET_PEAK)
    except OSError:
        return False
    return True


def _memory_mb(key: str) -> float:
    lines = (PROCESS / "status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{key}:"))
