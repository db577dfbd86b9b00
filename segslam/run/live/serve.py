"""The front process: receives scans, estimates their poses by odometry and publishes the poses."""

import signal
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Event, Thread
from time import monotonic
from typing import Any

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.memory import keep_freed_memory
from segslam.core.types import BadScan, Points, Scan, SegslamError, Step
from segslam.odometry.apart import OdometryApart
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.motion_model import WINDOW
from segslam.odometry.tracker import Tracked, Tracker
from segslam.run.live.waiting import Arrival, Source, Tally, Waiting
from segslam.scans.presets import Preset, extent_of, preset_for

READY = b"ready"
END_S = 5.0
"""Chosen: time for a source to end; the process does not wait longer for a middleware that hangs."""
MOST_SHOWN = 200
"""Chosen: number of characters shown of an exception, which may contain the content of a file."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A scan with its odometry pose, or an unusable scan."""

    tracked: Tracked | BadScan
    latency_s: float
    """Time from the arrival of the scan to the publication of its pose."""
    placed_s: float
    """Time of the publication, by time.monotonic."""

    @property
    def is_keyframe(self) -> bool:
        """Whether the scan becomes a keyframe."""
        return isinstance(self.tracked, Tracked) and self.tracked.registered is not None


@dataclass(frozen=True, slots=True)
class Chosen:
    """The preset that fits the first scan with a pose."""

    preset: Preset
    extent_m: float | None
    """As `segslam.scans.presets.extent_of`."""


@dataclass(frozen=True, slots=True)
class Ended:
    """End of the stream, and its reason."""

    why: str = ""
    """Empty if the stop was requested."""
    failed: bool = False
    died: bool = False
    """True if the process can be started again."""


@dataclass(slots=True, eq=False)
class Past:
    """The scans of front processes that have ended."""

    steps: list[Step]
    """Poses and motions only."""
    clouds: deque[tuple[int, Points]]
    """Row and points of the last keyframes."""
    preset: Preset | None = None
    """None before the first scan with a pose."""


Track = Callable[..., Tracked]
"""As `Tracker.track`."""


class OdometryEnded(Exception):
    """The process of the odometry has ended, so this process cannot place further scans."""


def serve(
    pipe: Connection, source: Source, configs: Mapping[Preset, Config], idle_s: float | None, past: Past, tally: Tally
) -> None:
    """Process scans until the source ends, `idle_s` pass without a scan, or the main process sends or closes.

    The first scan chooses one of `configs`, or follows those of `past`; `tally` counts the scans, in memory shared with
    the main process.
    """
    keep_freed_memory()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the main process handles both, and then stops this process
    to_send: SimpleQueue[Any] = SimpleQueue()
    sender = Thread(target=_send, args=(pipe, to_send), daemon=True)
    sender.start()
    waiting, stopped = Waiting(tally=tally), Event()
    fed = [Ended("the source has failed", failed=True)]  # remains after an unexpected exception
    feeder = Thread(target=_feed, args=(source, waiting, stopped, fed), name="feed", daemon=True)
    config = configs[past.preset or "driving"]
    try:
        with OdometryApart(config.odometry) as odometry:
            _warm_up(config, odometry)
            track = _choosing(configs, odometry, to_send.put)
            if past.preset:
                track = _continued(Tracker(config, odometry=odometry), past, waiting).track
            source.open(to_send.put)
            to_send.put(READY)
            feeder.start()
            Thread(target=_listen, args=(pipe, waiting, stopped), daemon=True).start()
            try:
                is_idle = _place_all(track, source, waiting, to_send, idle_s, past)
            finally:
                stopped.set()
                feeder.join(timeout=END_S)
            ended = replace(fed[0], why=f"no scan for {idle_s:g} s") if is_idle else fed[0]
            if feeder.is_alive():
                ended = Ended(f"the source did not end within {END_S:g} s")
    except (SegslamError, OdometryEnded) as error:
        ended = Ended(str(error), failed=True, died=isinstance(error, OdometryEnded))
    finally:
        if not feeder.is_alive():
            source.close()
    to_send.put(ended)
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


def _choosing(configs: Mapping[Preset, Config], odometry: OdometryApart, tell: Callable[[Chosen], None]) -> Track:
    """Tracks with the settings that fit the first scan with a pose, which are passed to `tell`."""
    chosen_tracker: Tracker | None = None

    def track(scan: Scan, *, gap: float) -> Tracked:
        nonlocal chosen_tracker
        if chosen_tracker:
            return chosen_tracker.track(scan, gap=gap)
        extent_m = extent_of(scan.points)
        chosen = Chosen(preset_for(extent_m), extent_m)
        config = configs[chosen.preset]
        odometry.begin(config.odometry)
        tracker = Tracker(config, odometry=odometry)
        tracked = tracker.track(scan, gap=gap)
        chosen_tracker = tracker
        tell(chosen)
        return tracked

    return track


def _continued(tracker: Tracker, past: Past, waiting: Waiting) -> Tracker:
    """The tracker after the scans of earlier processes: its maps contain the last keyframes."""
    if not past.steps:
        return tracker
    for step in past.steps:
        tracker.note(step)
    for step in past.steps[-WINDOW:]:
        waiting.rhythm.intervals.note(step.stamp_ns)  # the gaps between these scans are counted already
    keyframes = [row for row, _ in past.clouds]
    last = range(max(len(past.steps) - WINDOW, keyframes[0]), len(past.steps))
    rows = sorted({*keyframes, *last})
    steps = [past.steps[row] for row in rows]

    def scan_of(number: int) -> Scan:
        """The cloud of the last keyframe, as seen from the pose of another scan."""
        row = max(row for row in keyframes if row <= rows[number])
        points = past.clouds[keyframes.index(row)][1]
        T_scan_keyframe = geometry.inverse(steps[number].T_odom_lidar) @ past.steps[row].T_odom_lidar
        return Scan(geometry.apply(T_scan_keyframe, points), steps[number].stamp_ns, steps[number].scan_index)

    poses, stamps_ns = zip(*((step.T_odom_lidar, step.stamp_ns) for step in steps), strict=True)
    tracker.resume(np.stack(poses), np.array(stamps_ns), scan_of)
    return tracker


def _place_all(
    track: Track, source: Source, waiting: Waiting, to_send: "SimpleQueue[Any]", idle_s: float | None, past: Past
) -> bool:
    """Process each scan. Returns True if it ended because no scan came for `idle_s`."""
    last_ns = past.steps[-1].stamp_ns if past.steps else None
    while (arrival := waiting.take(idle_s)) is not None:
        gap = 1.0 if last_ns is None else waiting.rhythm.intervals.gap(arrival.stamp_ns, last_ns)
        tracked = _tracked(track, arrival, gap)
        if isinstance(tracked, Tracked):
            last_ns = arrival.stamp_ns
            try:
                source.publish(arrival, tracked.T_odom_lidar)
            except Exception as error:  # concerns the subscribers only
                why = f"{source.name}: the pose of scan {arrival.index} was not published ({error!r})"
                to_send.put(why[:MOST_SHOWN])
        now = monotonic()
        to_send.put(Placed(tracked, now - arrival.arrived_s, now))
    return not waiting.is_closed


def _tracked(track: Track, arrival: Arrival, gap: float) -> Tracked | BadScan:
    """The pose of a scan; BadScan for any exception of a single scan, because the run continues."""
    try:
        return track(arrival.read(arrival.index, arrival.stamp_ns), gap=gap)
    except BadScan as error:
        return error
    except SegslamError as error:
        raise OdometryEnded(str(error).partition("; continue")[0]) from error
    except Exception as error:
        shown = f"{type(error).__name__}: {error}".splitlines()[0][:MOST_SHOWN]
        return BadScan(f"scan {arrival.index}: cannot be used ({shown})")


def _feed(source: Source, waiting: Waiting, stopped: Event, ended: list[Ended]) -> None:
    """Feed the queue until the source ends; the queue is then closed, and the end is in `ended`."""
    try:
        ended[0] = Ended(source.feed(waiting, stopped))
    except (SegslamError, OSError) as error:
        ended[0] = Ended(str(error), failed=True)
    finally:
        waiting.close()


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
