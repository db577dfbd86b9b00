"""Status line of a live run, and its figures in `metrics.json`."""

import sys
from collections.abc import Mapping
from statistics import median
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from segslam.run.live import Ended, Placed

LINE_EVERY_S, BAR_EVERY_S = 10.0, 0.2
LATE_S = 5.0
"""Larger delays of loop closing are shown."""
MANY_DROPPED = 0.02
"""Chosen: share of dropped scans above which a faster odometry is recommended."""
COARSER = 1.5
"""Measured: KISS-ICP with voxels of 1.5 m takes 0.36 to 0.50 of the time that it takes with 1 m (docs/live.md)."""


class LiveFigures:
    """Latencies, delays and counts of a live run."""

    def __init__(self) -> None:
        self._latency_ms: list[float] = []
        self._lag_s: list[float] = []
        self._num_unsearched = 0
        self._started = monotonic()
        self.num_dropped = self.num_missing = 0

    def note(self, placed: "Placed", *, lag_s: float, tries_loops: bool) -> None:
        """Record a scan that was mapped and logged."""
        from segslam.odometry import Tracked

        self._latency_ms.append(1000 * placed.latency_s)
        self._lag_s.append(lag_s)
        is_keyframe = isinstance(placed.tracked, Tracked) and placed.tracked.registered is not None
        self._num_unsearched += is_keyframe and not tries_loops
        self.num_dropped, self.num_missing = placed.num_dropped, placed.gaps.num_missing

    def metrics(self, ended: "Ended", *, num_restarts: int) -> dict[str, Any]:
        """The figures of `metrics.json` that only live runs have."""
        num_dropped = max(self.num_dropped, ended.num_dropped)
        return {
            "num_scans_arrived": ended.num_arrived or len(self._lag_s) + num_dropped,
            "num_scans_dropped": num_dropped,
            "num_scans_missing": max(self.num_missing, ended.gaps.num_missing),
            "num_gaps": ended.gaps.num_gaps,
            "longest_gap_s": ended.gaps.longest_gap_s,
            "num_clock_set": ended.gaps.num_clock_set,
            "num_restarts": num_restarts,
            "num_keyframes_unsearched": self._num_unsearched,
            "latency_ms": _spread(self._latency_ms),
            "loop_lag_s": _spread(self._lag_s),
        }

    def line(self) -> str:
        """The status in one line."""
        num = len(self._lag_s)
        rate = num / max(monotonic() - self._started, 1e-9)
        text = f"live: {num} scans, {rate:.1f}/s"
        if num:
            text += f", pose {median(self._latency_ms[-20:]):.0f} ms after the scan"
            if self._lag_s[-1] > LATE_S:
                text += f", loops {self._lag_s[-1]:.1f} s behind"
        if self.num_dropped:
            text += f", {self.num_dropped} dropped"
        if self.num_missing:
            text += f", {self.num_missing} missing"
        return text


def too_slow(metrics: Mapping[str, Any], voxel_size_m: float) -> str:
    """Advice after a run whose odometry dropped many scans; empty if it dropped few, or because a process died."""
    num_dropped, num_arrived = metrics["num_scans_dropped"], metrics["num_scans_arrived"]
    if num_dropped <= MANY_DROPPED * num_arrived or metrics.get("num_restarts"):
        return ""
    return (
        f"{num_dropped} of {num_arrived} scans were dropped because odometry took too long; "
        f"--set odometry.voxel_size_m={COARSER * voxel_size_m:g} takes about half the time"
    )


class Status:
    """Status line that is updated on a terminal, printed every ten seconds elsewhere; a context manager."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._shown = monotonic()
        self._bar: Any = None

    def __enter__(self) -> "Status":
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import Progress, SpinnerColumn, TextColumn

            columns = (SpinnerColumn(), TextColumn("{task.description}"))
            self._bar = Progress(*columns, console=Console(stderr=True)).__enter__()
            self._task = self._bar.add_task("live: no scan yet", total=None)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.__exit__(kind, error, trace)

    def show(self, figures: LiveFigures) -> None:
        """Show the status if it is due."""
        now = monotonic()
        if self._quiet or now - self._shown < (LINE_EVERY_S if self._bar is None else BAR_EVERY_S):
            return
        self._shown = now
        if self._bar is None:
            print(figures.line(), file=sys.stderr)
        else:
            self._bar.update(self._task, description=figures.line())


def _spread(values: list[float]) -> dict[str, float]:
    """Median, 95th percentile and maximum."""
    ordered = sorted(values)
    return {"median": median(ordered), "p95": ordered[int(0.95 * (len(ordered) - 1))], "max": ordered[-1]}
