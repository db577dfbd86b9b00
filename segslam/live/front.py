"""The front process: receives scans, estimates their poses by odometry and publishes the poses.

Loop closing, graph, log and viewers run in the main process. They cannot delay a pose: poses are sent to the main
process by a separate thread, and the only message in the other direction is the request to stop.
"""

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Event, Thread
from time import monotonic
from typing import Any

import numpy as np

from segslam.config import Config
from segslam.live.source import Source
from segslam.live.waiting import Waiting
from segslam.odometry import KissOdometry, OdometryApart
from segslam.system.memory import keep_freed_memory
from segslam.tracker import Tracked, Tracker
from segslam.types import BadScan, Scan, SegslamError

READY = b"ready"
END_S = 5.0
"""Chosen: time for a source to end; the process does not wait longer for a middleware that hangs."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A scan with its odometry pose, or an unusable scan, and the counts so far."""

    tracked: Tracked | BadScan
    latency_s: float
    """Time from the arrival of the scan to the publication of its pose."""
    placed_s: float
    """Time of the publication, by time.monotonic."""
    num_dropped: int
    num_missing: int


@dataclass(frozen=True, slots=True)
class Ended:
    """End of the stream: reason and final counts."""

    why: str = ""
    """Empty if the stop was requested."""
    failed: bool = False
    num_arrived: int = 0
    num_dropped: int = 0
    num_gaps: int = 0
    num_missing: int = 0
    longest_gap_s: float = 0.0
    num_set_back: int = 0


class Front:
    """The front process as seen from the main process: an iterator of `Placed`; a context manager."""

    def __init__(
        self, source: Source, config: Config, *, tell: Callable[[str], None], idle_s: float | None = None
    ) -> None:
        """Start the process. `tell` prints messages of the source.

        The stream ends after `idle_s` without a scan, unless it is None.
        """
        self._tell = tell
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, source, config, idle_s), name="front")
        self._process.start()
        theirs.close()
        self._received: SimpleQueue[Any] = SimpleQueue()
        self.num_keyframes_waiting = 0
        self.ended = Ended()
        Thread(target=self._receive, name="receive", daemon=True).start()

    def wait_until_ready(self) -> None:
        """Wait until arriving scans are processed. Raises SegslamError if the source cannot be opened."""
        first = self._received.get()
        if isinstance(first, Ended):
            raise SegslamError(first.why)

    def __iter__(self) -> Iterator[Placed]:
        while not isinstance(item := self._received.get(), Ended):
            if _is_keyframe(item):
                self.num_keyframes_waiting -= 1
            yield item
        self.ended = item

    def stop(self) -> None:
        """Accept no more scans; waiting scans are still processed."""
        with suppress(OSError):
            self._pipe.send(None)

    def __enter__(self) -> "Front":
        return self

    def __exit__(self, *_: object) -> None:
        self._pipe.close()
        self._process.join()

    def _receive(self) -> None:
        try:
            while True:
                item = self._pipe.recv()
                if _is_keyframe(item):
                    self.num_keyframes_waiting += 1
                if isinstance(item, str):
                    self._tell(item)
                else:
                    self._received.put(item)
        except (EOFError, OSError):
            self._process.join(timeout=1.0)
            code = self._process.exitcode
            why = f"the odometry process has ended (exit code {code}; -9 is often a lack of memory)"
            self._received.put(Ended(why, failed=True))


def _is_keyframe(item: object) -> bool:
    return isinstance(item, Placed) and isinstance(item.tracked, Tracked) and item.tracked.registered is not None


def _serve(pipe: Connection, source: Source, config: Config, idle_s: float | None) -> None:
    """Process scans until the source ends, `idle_s` pass without a scan, or the main process sends or closes."""
    keep_freed_memory()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the main process handles both, and then stops this process
    to_send: SimpleQueue[Any] = SimpleQueue()
    sender = Thread(target=_send, args=(pipe, to_send), daemon=True)
    sender.start()
    waiting, stopped = Waiting(), Event()
    why, failed = "", False
    feeder: _Feeder | None = None
    try:
        with OdometryApart(config.odometry) as odometry:
            _warm_up(config, odometry)
            source.open(to_send.put)
            to_send.put(READY)
            feeder = _Feeder(source, waiting, stopped)
            Thread(target=_listen, args=(pipe, waiting, stopped), daemon=True).start()
            try:
                is_idle = _place_all(Tracker(config, odometry=odometry), source, waiting, to_send, idle_s)
            finally:
                stopped.set()
                feeder.join(timeout=END_S)
            why = f"no scan for {idle_s:g} s" if is_idle else feeder.why
            failed = feeder.failed
            if feeder.is_alive():
                why, failed = f"the source did not end within {END_S:g} s", False
    except SegslamError as error:
        why, failed = str(error), True
    finally:
        if feeder is None or not feeder.is_alive():
            source.close()
    rhythm = waiting.rhythm
    to_send.put(
        Ended(
            why,
            failed,
            waiting.num_arrived,
            waiting.num_dropped,
            rhythm.num_gaps,
            rhythm.num_missing,
            rhythm.longest_gap_s,
            rhythm.num_set_back,
        )
    )
    to_send.put(None)
    sender.join()


def _warm_up(config: Config, odometry: OdometryApart) -> None:
    """Load what the first scan needs; this takes seconds, in which the first scans would be dropped."""
    odometry.follow([], np.eye(4), np.eye(4))
    throwaway = Tracker(config, odometry=KissOdometry(config.odometry))
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    points *= 0.5 * (config.odometry.min_range_m + config.odometry.max_range_m) / np.abs(points).max(axis=1)[:, None]
    for stamp_ns in (0, 100_000_000, 400_000_000):  # the last one after a gap, so that its motion is checked
        throwaway.track(Scan(points, stamp_ns))


def _place_all(
    tracker: Tracker, source: Source, waiting: Waiting, to_send: "SimpleQueue[Any]", idle_s: float | None
) -> bool:
    """Process each scan. Returns True if it ended because no scan came for `idle_s`."""
    last_ns: int | None = None
    while (arrival := waiting.take(idle_s)) is not None:
        tracked: Tracked | BadScan
        try:
            gap = 1.0 if last_ns is None else waiting.rhythm.intervals(last_ns, arrival.stamp_ns)
            tracked = tracker.track(arrival.read(arrival.index, arrival.stamp_ns), gap=gap)
            source.publish(arrival, tracked.T_odom_lidar)
            last_ns = arrival.stamp_ns
        except BadScan as error:
            tracked = error
        now = monotonic()
        counts = (waiting.num_dropped, waiting.rhythm.num_missing)
        to_send.put(Placed(tracked, now - arrival.arrived_s, now, *counts))
    return not waiting.is_closed


class _Feeder(Thread):
    """Thread that runs the source's `feed`."""

    def __init__(self, source: Source, waiting: Waiting, stopped: Event) -> None:
        super().__init__(name="feed", daemon=True)
        self._source, self._waiting, self._stopped = source, waiting, stopped
        self.why, self.failed = "", False
        self.start()

    def run(self) -> None:
        """Run until the source ends; the queue is then closed."""
        self.why, self.failed = "the source has failed", True  # remains after an unexpected exception
        try:
            self.why, self.failed = self._source.feed(self._waiting, self._stopped), False
        except (SegslamError, OSError) as error:
            self.why, self.failed = str(error), True
        finally:
            self._waiting.close()


def _listen(pipe: Connection, waiting: Waiting, stopped: Event) -> None:
    """Stop when the main process requests it or has ended."""
    with suppress(EOFError, OSError):
        pipe.recv()
    stopped.set()
    waiting.close()


def _send(pipe: Connection, to_send: "SimpleQueue[Any]") -> None:
    with suppress(OSError):
        while (item := to_send.get()) is not None:
            pipe.send(item)
