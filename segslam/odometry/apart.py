"""KISS-ICP in a process of its own: it holds Python's lock while it aligns, and other work would wait."""

import multiprocessing
import signal
from multiprocessing.connection import Connection

from segslam.config import OdometryConfig
from segslam.odometry.kiss import KissAligner, KissOdometry
from segslam.types import Points, SegslamError, Transform


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
    """A `KissAligner` in another process: points go there, poses come back."""

    def __init__(self, config: OdometryConfig) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would take along the locks of other threads
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, config), name="odometry", daemon=True)
        self._process.start()
        theirs.close()

    def align(self, points: Points) -> Transform:
        """T_odom_lidar of the next sweep."""
        try:
            self._pipe.send((None, points))
            T_odom_lidar: Transform = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise self._ended() from error
        return T_odom_lidar

    def restore(self, T_odom_lidar: Transform, points: Points | None) -> None:
        """As `KissAligner.restore`."""
        try:
            self._pipe.send((T_odom_lidar, points))
        except OSError as error:
            raise self._ended() from error

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


def _serve(pipe: Connection, config: OdometryConfig) -> None:
    """Until the other side closes: points without a pose are aligned and answered, points with one restored."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the other side, which then closes
    aligner = KissAligner(config)
    try:
        while True:
            T_odom_lidar, points = pipe.recv()
            if T_odom_lidar is None:
                pipe.send(aligner.align(points))
            else:
                aligner.restore(T_odom_lidar, points)
    except (EOFError, OSError):
        return
