"""The front process as seen from the main process: poses of the scans, as they come.

It does not wait for other work: a thread sends the poses, and the only message in return is the request to stop. If it
dies, for example for lack of memory, another one continues from its last poses.
"""

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from multiprocessing.sharedctypes import RawValue
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any

from segslam.core.config import Config
from segslam.core.errors import counted
from segslam.core.memory import note_peak_of
from segslam.core.types import SegslamError, Step
from segslam.odometry.tracker import Tracked
from segslam.run.live.serve import END_S, READY, Chosen, Ended, Past, Placed, serve
from segslam.run.live.waiting import WAKE_S, Source, Tally
from segslam.scans.presets import Preset

CLOUDS_KEPT = 20
"""Chosen: number of keyframes whose points are kept for a new front process, about 1.5 MB each."""


class Front:
    """The front process as seen from the main process: an iterator of `Placed`; a context manager."""

    def __init__(
        self,
        source: Source,
        configs: Mapping[Preset, Config],
        *,
        tell: Callable[[str], None],
        idle_s: float | None = None,
    ) -> None:
        """Start the process, which uses the settings of the preset that fits the first scan with a pose.

        `tell` prints messages of the source. Iterate after `wait_until_chosen`. The stream ends after `idle_s` without
        a scan, unless it is None.
        """
        self._tell = tell
        self._serving = source, configs, idle_s
        self._is_ready = False
        self.is_stopping = False
        """True after `stop`."""
        self.tally = RawValue(Tally)
        self._past = Past([], deque(maxlen=CLOUDS_KEPT))
        self._num_placed = 0
        self._received: SimpleQueue[Any] = SimpleQueue()
        self._before_chosen: list[Any] = []
        """Unusable scans before the first scan with a pose, and the end if there is none."""
        self.num_keyframes_waiting = 0
        self.num_restarts = 0
        self.ended = Ended()
        self._start()
        self._receiver = Thread(target=self._receive_all, name="receive", daemon=True)
        self._receiver.start()

    def wait_until_ready(self) -> None:
        """Wait until arriving scans are processed. Raises SegslamError if the source cannot be opened."""
        first = self._next()
        if isinstance(first, Ended):
            raise SegslamError(first.why)

    def wait_until_chosen(self) -> Chosen | None:
        """Wait for the first scan with a pose; the preset that fits it, or None if the stream ends without one."""
        while not isinstance(item := self._next(), Chosen):
            self._before_chosen.append(item)
            if isinstance(item, Ended):
                return None
        return item

    def __iter__(self) -> Iterator[Placed]:
        for item in chain(self._before_chosen, iter(self._next, None)):
            if isinstance(item, Ended):
                self.ended = item
                return
            self.num_keyframes_waiting -= item.is_keyframe
            yield item

    def _next(self) -> Any:
        """The next item received. A signal that arrives just before a wait does not end the wait, so each is short."""
        while True:
            with suppress(Empty):
                return self._received.get(timeout=WAKE_S)

    def stop(self) -> None:
        """Accept no more scans; waiting scans are still processed."""
        self.is_stopping = True
        with suppress(OSError):
            self._pipe.send(None)

    def __enter__(self) -> "Front":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        while self._receiver.is_alive():
            self._process.join(2 * END_S)
            self._process.kill()  # no effect on a process that has ended
            self._receiver.join(END_S)
        self._pipe.close()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        arguments = (theirs, *self._serving, self._past, self.tally)
        self._process = context.Process(target=serve, args=arguments, name="front")
        self._process.start()
        theirs.close()
        if self.is_stopping:
            self.stop()

    def _receive_all(self) -> None:
        """As `_receive`; a failure ends the stream, for example if there is no memory for another front process."""
        try:
            self._receive()
        except Exception as error:
            self._received.put(Ended(f"the odometry process cannot be followed ({error!r})", failed=True))

    def _receive(self) -> None:
        """Pass on what the front process sends, and start another one if it dies."""
        while (died := self._receive_until_dead()) is not None:
            self._process.join(timeout=1.0)
            num_lost = self.tally.num_arrived - self.tally.num_dropped - self._num_placed
            self.tally.num_dropped += num_lost
            if self.is_stopping or not self._is_ready:
                self._received.put(replace(died, failed=not self.is_stopping))  # a death while it stops is no failure
                return
            lost = f"{counted(num_lost, 'scan')} lost" if num_lost else "no scan lost"
            self._tell(f"{died.why}: {lost}; starting it again ...")
            self._is_ready = False
            self.num_restarts += 1
            self._pipe.close()
            self._start()

    def _receive_until_dead(self) -> Ended | None:
        """None after the regular end of the stream, otherwise what the process died of."""
        while True:
            try:
                item = self._pipe.recv()
            except (EOFError, OSError):
                self._process.join(timeout=1.0)
                why = f"the odometry process has ended ({_cause(self._process.exitcode)})"
                return Ended(why, failed=True, died=True)
            if isinstance(item, Ended):
                if item.died:
                    return item
                note_peak_of(self._process.pid)
                self._received.put(item)
                return None
            self._take(item)

    def _take(self, item: object) -> None:
        if isinstance(item, str):
            self._tell(item)
            return
        if item == READY:
            self._is_ready = True
            if self.num_restarts:
                self._tell("the odometry runs again")
                return
        if isinstance(item, Chosen):
            self._past.preset = item.preset
        if isinstance(item, Placed):
            self._num_placed += 1
            if isinstance(item.tracked, Tracked):
                self._note(item.tracked)
        self._received.put(item)

    def _note(self, tracked: Tracked) -> None:
        """Note what another front process needs to continue after this scan."""
        if tracked.registered is not None:
            self.num_keyframes_waiting += 1
            self._past.clouds.append((len(self._past.steps), tracked.registered.points))
        step = Step(tracked.scan_index, tracked.stamp_ns, tracked.T_odom_lidar, None, (), None, {}, tracked.motion)
        self._past.steps.append(step)


def _cause(exit_code: int | None) -> str:
    """The exit code of a process in words."""
    if exit_code is None or exit_code >= 0:
        return f"exit code {exit_code}"
    number = signal.Signals(-exit_code)
    return f"signal {number.name}{', often a lack of memory' if number == signal.SIGKILL else ''}"
