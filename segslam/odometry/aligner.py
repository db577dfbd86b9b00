"""KISS-ICP's alignment of a sweep with its map, in this process or for another one.

A process that only aligns imports this module and little else: the rest of the package takes twice its memory.
"""

import signal
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from kiss_icp.config.parser import KISSConfig
from kiss_icp.kiss_icp import KissICP
from kiss_icp.registration import Registration

from segslam.core.memory import keep_freed_memory
from segslam.core.types import Points, Transform


class KissAligner:
    """Aligns consecutive sweeps with KISS-ICP's map of the previous ones.

    Its threads sum in any order, so its poses repeat to 1e-12 m only. They are rounded before anything depends on them,
    to a tenth of the step (m, rad) at which its iteration ends: poses are the same in each run.
    """

    def __init__(self, config: KISSConfig) -> None:
        self._config = config
        self._kiss = self._first = _kiss(config)
        self._alone: list[Transform] = []

    def follow(self, scans: Sequence[tuple[Transform, Points]], T_odom_lidar: Transform) -> None:
        """As `Odometry.follow`: the previous state is discarded."""
        self._kiss = kiss = _kiss(self._config)
        for T_odom_scan, points in scans:
            kiss.local_map.update(points.astype(np.float64), T_odom_scan)
        kiss.last_pose = np.array(T_odom_lidar)

    def align(self, points: Points, T_last_predicted: Transform) -> Transform:
        """T_odom_lidar of the next sweep from its points (n, 3), float64, and its expected motion since the last."""
        return _registered(self._kiss, points, T_last_predicted)

    def align_alone(self, points: Points, T_last_predicted: Transform) -> None:
        """Align a sweep as well with KISS-ICP as it was before the first `follow`; `alone` returns the pose."""
        self._alone.append(_registered(self._first, points, T_last_predicted))

    def keep(self, T_odom_lidar: Transform) -> None:
        """Add to `alone` the pose of a sweep before the first `follow`, which `align` has found already."""
        self._alone.append(T_odom_lidar)

    def alone(self) -> list[Transform]:
        """The poses given to `keep`, then that of each sweep passed to `align_alone`."""
        return self._alone


class _Rounded(Registration):
    def __init__(self, *, convergence_criterion: float, **settings: int) -> None:
        super().__init__(convergence_criterion=convergence_criterion, **settings)
        self._step = convergence_criterion / 10.0

    def align_points_to_map(self, *args: Any, **keywords: Any) -> Transform:
        T_odom_lidar = np.round(super().align_points_to_map(*args, **keywords) / self._step) * self._step
        u, _, vt = np.linalg.svd(T_odom_lidar[:3, :3])
        T_odom_lidar[:3, :3] = u @ vt
        return T_odom_lidar


def _kiss(config: KISSConfig) -> KissICP:
    kiss = KissICP(config)
    kiss.registration = _Rounded(**config.registration.model_dump())
    return kiss


def _registered(kiss: KissICP, points: Points, T_last_predicted: Transform) -> Transform:
    kiss.last_delta = np.array(T_last_predicted)
    kiss.register_frame(points, np.empty(0))
    return np.array(kiss.last_pose)


def as_points(shared: Any) -> Points:
    """Shared memory as rows of float64 coordinates; no rows without shared memory."""
    return np.empty((0, 3)) if shared is None else np.frombuffer(shared).reshape(-1, 3)


def serve(pipe: Connection, shared: Sequence[Any], config: KISSConfig) -> None:
    """Answer requests until the other side closes the pipe: the name of a method of the aligner, and its arguments.

    `begin` gets no answer, and `align_alone` the pose. Points of a sweep are sent themselves or, if they are in the
    shared memory, as their number: in the first, for `align_alone` in the second.
    """
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles Ctrl-C and then closes the pipe
    aligner = KissAligner(config)
    for_align, for_alone = map(as_points, shared)
    try:
        while True:
            name, first, *rest = pipe.recv()
            if name == "begin":
                aligner = KissAligner(first)
                continue
            points = for_alone if name == "align_alone" else for_align
            answer = getattr(aligner, name)(points[:first] if isinstance(first, int) else first, *rest)
            pipe.send(aligner.alone().pop() if name == "align_alone" else answer)
    except (EOFError, OSError):
        return
