"""KISS-ICP in a process of its own: it holds Python's lock while it aligns, and other work would wait."""

import multiprocessing
import signal
from collections.abc import Sequence
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from typing import Any

import numpy as np

from segslam.config import OdometryConfig
from segslam.odometry.kiss import KissAligner, KissOdometry
from segslam.system.memory import keep_freed_memory
from segslam.types import Points, SegslamError, Transform

MOST_SHARED = 2**18
"""Points of a sweep that two processes hand over in memory they share, 6 MB; a larger sweep goes through the pipe."""


class OdometryApart(KissOdometry):
    """As `KissOdometry`; while a scan is aligned, the thread that asks waits with Python's lock released.

    Its process starts at once; close it, or leave its `with`, when no more scans follow. Every method raises
    SegslamError if the process has ended. The process imports the script that is run, as all spawned ones do: a script
    that uses this class needs `if __name__ == "__main__":`.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self._apart = _AlignerApart(config)
        super().__init__(config, self._apart)

    def __enter__(self) -> "OdometryApart":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process; nothing is lost."""
        self._apart.close()


class _AlignerApart:
    """A `KissAligner` in another process: points go there, poses come back. It has one request at a time."""

    def __init__(self, config: OdometryConfig) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would take along the locks of other threads
        self._pipe, theirs = context.Pipe()
        shared = _room_for_points(context)
        self._shared = _as_points(shared)
        self._process = context.Process(target=_serve, args=(theirs, shared, config), name="odometry", daemon=True)
        self._process.start()
        theirs.close()

    def align(self, points: Points, gap: float = 1.0) -> Transform:
        """T_odom_lidar of the next sweep, `gap` intervals after the one before."""
        return self._asked(gap, points)

    def restore(self, T_odom_lidar: Transform, points: Points | None) -> None:
        """As `KissAligner.restore`."""
        self._asked(T_odom_lidar, points)

    def follow(
        self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform, T_before_lidar: Transform
    ) -> None:
        """As `Odometry.follow`."""
        self._exchange((list(scans), T_odom_lidar, T_before_lidar))

    def _asked(self, known: Transform | float, points: Points | None) -> Transform:
        """The pose of the sweep: the one given or, after a gap, the one it is found at."""
        sent: Points | int | None = points
        if points is not None and len(points) <= len(self._shared):
            self._shared[: len(points)] = points
            sent = len(points)
        return self._exchange((known, sent))

    def _exchange(self, request: tuple[Any, ...]) -> Transform:
        try:
            self._pipe.send(request)
            answer: Transform = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise self._ended() from error
        return answer

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join()

    def _ended(self) -> SegslamError:
        self._process.join(timeout=1.0)
        return SegslamError(
            f"the odometry's process has ended (exit code {self._process.exitcode}; -9 is often want of memory); "
            "go on by `segslam map --resume`"
        )


def _room_for_points(context: SpawnContext) -> Any:
    """Memory that two processes share; none where the system grants none, as where files may not be that large."""
    try:
        return context.RawArray("d", 3 * MOST_SHARED)
    except OSError:
        return None


def _as_points(shared: Any) -> Points:
    """The shared memory as rows of float64 coordinates; no row where there is none."""
    return np.empty((0, 3)) if shared is None else np.frombuffer(shared).reshape(-1, 3)


def _serve(pipe: Connection, shared: Any, config: OdometryConfig) -> None:
    """Until the other side closes: points with a gap are aligned, points with a pose restored; the pose is answered.

    Three things are the arguments of `follow`.

    The points come themselves, or their number where they are in the shared memory.
    """
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the other side, which then closes
    aligner = KissAligner(config)
    shared_points = _as_points(shared)
    try:
        while True:
            request = pipe.recv()
            if len(request) == 3:
                aligner.follow(*request)
                pipe.send(request[1])
                continue
            known, sent = request
            points = shared_points[:sent] if isinstance(sent, int) else sent
            if isinstance(known, float):
                known = aligner.align(points, known)
            else:
                aligner.restore(known, points)
            pipe.send(known)
    except (EOFError, OSError):
        return
