"""Measurement of time and additional memory."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

from segslam.core.memory import give_back, status_mb

CLEAR_REFS = Path("/proc/self/clear_refs")
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
    before_mb = None
    with suppress(OSError):
        CLEAR_REFS.write_text(RESET_PEAK)
        before_mb = status_mb("VmRSS")
    started, cpu_started = perf_counter(), process_time()
    yield cost
    cost.seconds, cost.cpu_seconds = perf_counter() - started, process_time() - cpu_started
    if before_mb is not None:
        cost.peak_mb = max((status_mb("VmHWM") or 0.0) - before_mb, 0.0)
