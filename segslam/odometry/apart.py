"""KISS-ICP in a process of its own: it holds Python's lock while it aligns, and other work would wait."""

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from segslam.config import OdometryConfig
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.sweep import OdometryResult
from segslam.trajectory import Poses
from segslam.types import Scan, SegslamError


class OdometryApart:
    """As `KissOdometry`, to the bit; the thread that asks waits with Python's lock released.

    Its process starts at once; close it, or leave its `with`, when no more scans follow.
    """

    def __init__(self, config: OdometryConfig) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would take along the locks of other threads
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, config), name="odometry", daemon=True)
        self._process.start()
        theirs.close()

    def __enter__(self) -> "OdometryApart":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def register(self, scan: Scan) -> OdometryResult:
        """As `KissOdometry.register`. Raises SegslamError if the process has ended."""
        self._send(scan)
        return self._received()

    def restore(self, T_odom_lidar: Poses, scan_of: Callable[[int], Scan]) -> None:
        """As `KissOdometry.restore`; the scans are read here."""
        self._send(T_odom_lidar)
        while (row := self._received()) is not None:
            self._send(scan_of(row))

    def close(self) -> None:
        """End the process; nothing is lost."""
        self._pipe.close()
        self._process.join()

    def _send(self, what: Any) -> None:
        try:
            self._pipe.send(what)
        except OSError as error:
            raise self._ended() from error

    def _received(self) -> Any:
        try:
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise self._ended() from error
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _ended(self) -> SegslamError:
        self._process.join(timeout=1.0)
        return SegslamError(
            f"the odometry's process has ended (exit code {self._process.exitcode}; -9 is often want of memory); "
            "go on by `segslam map --resume`"
        )


def _serve(pipe: Connection, config: OdometryConfig) -> None:
    """Answer until the other side closes: a scan by its result, poses by the rows to be read, then None."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the other side, which then closes

    def scan_of(row: int) -> Scan:
        pipe.send(row)
        scan: Scan = pipe.recv()
        return scan

    odometry = KissOdometry(config)
    try:
        while True:
            asked = pipe.recv()
            try:
                if isinstance(asked, Scan):
                    pipe.send(odometry.register(asked))
                else:
                    odometry.restore(asked, scan_of)
                    pipe.send(None)
            except (SegslamError, ValueError) as error:
                pipe.send(error)
    except (EOFError, OSError):
        return
