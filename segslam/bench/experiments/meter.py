"""Measurement of time and additional memory."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

from segslam.core.memory import give_back

PROCESS = Path("/proc/self")
RESET_PEAK = "5"
"""Value that, written to `clear_refs`, resets the peak memory to the current memory (Linux, proc(5))."""


@dataclass(slots=True)
class Cost:
    """Time and memory; the fields are set when the measured block ends."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """CPU time of all threads; more reliable than `seconds` on a busy machine."""
    peak_mb: float | None = None
    """Peak of additional memory; None if unknown. Invalid while other threads of the process work."""


@contextmanager
def measured() -> Iterator[Cost]:
    """Context manager that yields the cost of its block."""
    cost = Cost()
    give_back()
    before_mb = _memory_mb("VmRSS") if _reset_peak() else None
    started, cpu_started = perf_counter(), process_time()
    yield cost
    cost.seconds, cost.cpu_seconds = perf_counter() - started, process_time() - cpu_started
    if before_mb is not None:
        cost.peak_mb = max(_memory_mb("VmHWM") - before_mb, 0.0)


def _reset_peak() -> bool:
    try:
        (PROCESS / "clear_refs").write_text(RESET_PEAK)
    except OSError:
        return False
    return True


def _memory_mb(key: str) -> float:
    lines = (PROCESS / "status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{key}:"))
