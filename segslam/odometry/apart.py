"""KISS-ICP in a process of its own: it holds Python's lock while it aligns, and other work would wait."""

import multiprocessing
import signal
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from typing import Any

import numpy as np

from segslam.allocator import keep_freed_memory
from segslam.config import OdometryConfig
from segslam.odometry.kiss import KissAligner, KissOdometry
from segslam.types import Points, SegslamError, Transform

MOST_SHARED = 2**18
"""Points of a sweep that two processes hand over in memory they share, 6 MB; a larger sweep goes through the pipe."""


class OdometryApart(KissOdometry):
    """As `KissOdometry`; while a scan is aligned, the thread that asks waits with Python's lock released.

    Its process starts at once; close it, or leave its `with`, when no more scans follow. Every method raises
    SegslamError if the process has ended.
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

    def align(self, points: Points) -> Transform:
        """T_odom_lidar of the next sweep."""
        return self._asked(None, points)

    def restore(self, T_odom_lidar: Transform, points: Points | None) -> None:
        """As `KissAligner.restore`."""
        self._asked(T_odom_lidar, points)

    def _asked(self, T_odom_lidar: Transform | None, points: Points | None) -> Transform:
        """The pose of the sweep: the one given or, where it is None, the one it is found at."""
        sent: Points | int | None = points
        if points is not None and len(points) <= len(self._shared):
            self._shared[: len(points)] = points
            sent = len(points)
        try:
            self._pipe.send((T_odom_lidar, sent))
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
    """Until the other side closes: points without a pose are aligned, points with one restored; the pose is answered.

    The points come themselves, or their number where they are in the shared memory.
    """
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the other side, which then closes
    aligner = KissAligner(config)
    shared_points = _as_points(shared)
    try:
        while True:
            T_odom_lidar, sent = pipe.recv()
            points = shared_points[:sent] if isinstance(sent, int) else sent
            if T_odom_lidar is None:
                T_odom_lidar = aligner.align(points)
            else:
                aligner.restore(T_odom_lidar, points)
            pipe.send(T_odom_lidar)
    except (EOFError, OSError):
        return
