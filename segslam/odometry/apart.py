"""KISS-ICP in a separate process, because it holds Python's global lock while it aligns a scan."""

import multiprocessing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.context import SpawnContext
from typing import Any

from kiss_icp.config.parser import KISSConfig

from segslam.core import geometry
from segslam.core.config import OdometryConfig
from segslam.core.memory import note_peak_of
from segslam.core.types import BadScan, Points, Scan, SegslamError, Transform
from segslam.odometry.aligner import KissAligner, as_points, serve
from segslam.odometry.kiss import KissOdometry, kiss_config
from segslam.odometry.sweep import PosedScans, Swept, deskew_scan

MOST_SHARED = 2**18
"""Points of a sweep that the two processes exchange in shared memory, 6 MB; larger ones are sent through the pipe."""


class OdometryApart(KissOdometry):
    """`KissOdometry` in a separate process; while it aligns a scan, other threads of this process run.

    Its process starts at once. Leave the `with` block after the last scan. Every method raises SegslamError if the
    process has ended. The process imports the main script, as with every spawned process: a script that uses this class
    needs `if __name__ == "__main__":`.
    """

    def __init__(self, config: OdometryConfig, *, keeps_alone: bool = False) -> None:
        """`keeps_alone` as for `KissOdometry`; the other process aligns these scans while this one continues."""
        self._apart = _AlignerApart(kiss_config(config))
        self._foreseen: Swept | None = None
        super().__init__(config, self._apart, keeps_alone=keeps_alone)

    def begin(self, config: OdometryConfig) -> None:
        """Start again with other settings, in the same process."""
        self._apart.begin(kiss_config(config))
        super().__init__(config, self._apart, keeps_alone=self._keeps_alone)

    def foresee(self, scan: Scan, *, gap: float) -> None:
        """Begin to align the next scan, as if the pose of this one stays; `follow` discards the result."""
        with suppress(BadScan):  # `register` raises it
            swept = deskew_scan(scan, self._T_last_lidar, self._config)
            self._apart.begin_to_align(swept[0], geometry.scaled(self._T_last_lidar, gap))
            self._foreseen = swept

    def follow(self, scans: PosedScans, T_odom_lidar: Transform, T_before_lidar: Transform) -> None:
        """As `KissOdometry.follow`."""
        if self._foreseen is not None:
            T_discarded, self._foreseen = self._apart.begun(), None
            if self._keeps_alone and not self._has_followed:  # KISS-ICP alone has aligned the next scan with this
                self._apart.keep(T_discarded)
                self._T_sweep_alone = self._T_last_lidar
        super().follow(scans, T_odom_lidar, T_before_lidar)

    def _aligned(self, scan: Scan, gap: float) -> tuple[Swept, Transform]:
        if self._foreseen is None:
            return super()._aligned(scan, gap)
        swept, self._foreseen = self._foreseen, None
        return swept, self._apart.begun()

    def __enter__(self) -> "OdometryApart":
        return self

    def __exit__(self, *_: object) -> None:
        """End the process; no results are lost."""
        self._apart.close()


class _AlignerApart(KissAligner):
    """A `KissAligner` in another process, which handles one request at a time."""

    def __init__(self, config: KISSConfig) -> None:
        self._alone: list[Transform] = []
        self._is_waiting = False
        """True while an answer to `align_alone` has not been received."""
        context = multiprocessing.get_context("spawn")  # a fork would copy locks held by other threads
        self._pipe, theirs = context.Pipe()
        shared = [_room_for_points(context) for _ in range(2)]
        self._shared, self._shared_alone = map(as_points, shared)
        self._process = context.Process(target=serve, args=(theirs, shared, config), name="odometry", daemon=True)
        self._process.start()
        theirs.close()

    def begin(self, config: KISSConfig) -> None:
        """Replace the aligner by a new one."""
        self._send("begin", config)

    def align(self, points: Points, T_last_predicted: Transform) -> Transform:
        """As `KissAligner.align`."""
        self.begin_to_align(points, T_last_predicted)
        return self.begun()

    def follow(self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform) -> None:
        """As `KissAligner.follow`."""
        self.alone()
        self._send("follow", list(scans), T_odom_lidar)
        self._answer()

    def begin_to_align(self, points: Points, T_last_predicted: Transform) -> None:
        """As `align`, whose result `begun` returns; nothing but `alone` may be asked until then."""
        self._send("align", _shared_or_sent(points, self._shared), T_last_predicted)

    def begun(self) -> Transform:
        """The result of the alignment that was begun."""
        self.alone()
        return self._answer()

    def align_alone(self, points: Points, T_last_predicted: Transform) -> None:
        """As `KissAligner.align_alone`; the other process works while this one continues."""
        self.alone()  # the shared memory is in use until then
        self._send("align_alone", _shared_or_sent(points, self._shared_alone), T_last_predicted)
        self._is_waiting = True

    def alone(self) -> list[Transform]:
        """As `KissAligner.alone`, also after `close`."""
        if self._is_waiting:
            self._is_waiting = False
            self._alone.append(self._answer())
        return self._alone

    def _send(self, *request: Any) -> None:
        with self._reported():
            self._pipe.send(request)

    def _answer(self) -> Any:
        with self._reported():
            return self._pipe.recv()

    @contextmanager
    def _reported(self) -> Iterator[None]:
        """Context manager that raises SegslamError if the process has ended."""
        try:
            yield
        except (EOFError, OSError) as error:
            self._process.join(timeout=1.0)
            raise SegslamError(
                f"the odometry process has ended (exit code {self._process.exitcode}; -9 is often a lack of memory, 1 "
                'a script without `if __name__ == "__main__":`); continue with `segslam map --resume`'
            ) from error

    def close(self) -> None:
        """End the process."""
        with suppress(SegslamError):  # the process has ended already
            self.alone()
        note_peak_of(self._process.pid)
        self._pipe.close()
        self._process.join()


def _shared_or_sent(points: Points, shared: Points) -> Points | int:
    """The number of the points, which are then in the shared memory, or the points if they are too many."""
    if len(points) > len(shared):
        return points
    shared[: len(points)] = points
    return len(points)


def _room_for_points(context: SpawnContext) -> Any:
    """Memory shared by two processes; None if the system does not grant it."""
    try:
        return context.RawArray("d", 3 * MOST_SHARED)
    except OSError:
        return None
