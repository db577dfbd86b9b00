"""Front end of the pipeline: odometry, its check, and selection of keyframes. It uses no graph and no log."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.errors import BadScan, LateScan
from segslam.core.threads import Stopwatch
from segslam.core.trajectory import Poses
from segslam.core.types import Indices, Motion, MotionState, Scan, Step, Transform
from segslam.keyframes import KeyframeSelector
from segslam.odometry.checked import CheckedOdometry
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.local_map import MAP_SCANS
from segslam.odometry.motion_model import WINDOW
from segslam.odometry.sweep import Odometry, OdometryResult
from segslam.verification import register

RESUMED_SCANS = WINDOW + MAP_SCANS
"""Scans after which the local map is full and what is usual on a drive is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """A scan with its odometry pose. `Slam.close_loops` may process it while the next scan is tracked."""

    scan_index: int
    stamp_ns: int
    registered: OdometryResult | None
    """Data of the keyframe to be made; None if the scan does not become one."""
    T_odom_lidar: Transform
    travel_m: float
    motion: Motion
    watch: Stopwatch


class Tracker:
    """Estimates the pose of each scan by odometry. Its results may be sent to another process."""

    def __init__(self, config: Config, *, odometry: Odometry | None = None) -> None:
        """`odometry` replaces KISS-ICP."""
        self._config = config
        self._inner = odometry or KissOdometry(config.odometry)
        self._odometry = CheckedOdometry(self._inner, config, recover=partial(register, config=config))
        self._selector = KeyframeSelector(config.keyframes)
        self._T_odom_own = np.eye(4)
        """Pose of the frame of the odometry, which starts again after `resume`."""
        self._next_index = 0
        self._indices = set[int]()
        self._last_stamp_ns: int | None = None

    def track(self, scan: Scan, *, gap: float = 1.0, ahead: Scan | None = None) -> Tracked:
        """Estimate the pose of a scan, and decide whether it becomes a keyframe.

        `gap`: time since the previous scan in intervals of the sensor; above 1 if scans between them were lost. It
        scales the constant-velocity prediction of the odometry. `ahead`: the scan that is tracked next, without a gap,
        if it is known; the odometry then works on both at the same time, with the same results. Raises BadScan, and
        ignores the scan, if it cannot be used, is not later than the previous scan, or has the index of another.
        """
        index = self._next_index if scan.index is None else scan.index
        if self._last_stamp_ns is not None and scan.stamp_ns <= self._last_stamp_ns:
            raise LateScan(
                f"scan {index}: its stamp {scan.stamp_ns} ns is not later than that of the previous scan, "
                f"{self._last_stamp_ns} ns; give each scan once, in order of time and by one clock"
            )
        if index in self._indices:
            raise BadScan(f"scan {index}: an earlier scan has this index; give each its own, or none to any")
        scan = replace(scan, index=index)
        watch = Stopwatch()
        with watch("odometry"):
            registered = self._odometry.register(scan, gap=gap, ahead=ahead)
        registered = replace(registered, T_odom_lidar=self._T_odom_own @ registered.T_odom_lidar)
        self._last_stamp_ns = scan.stamp_ns
        self._note_index(index)
        T_odom_lidar = registered.T_odom_lidar
        motion = registered.motion or Motion(MotionState.UNCHECKED)
        is_keyframe = self._selector.update(T_odom_lidar, after_break=motion.is_break)
        kept = registered if is_keyframe else None
        return Tracked(index, scan.stamp_ns, kept, T_odom_lidar, self.travel_m, motion, watch)

    @property
    def travel_m(self) -> float:
        """Length of the path through all scans so far."""
        return self._selector.travel_m

    def alone(self) -> Sequence[Transform]:
        """The pose of each tracked scan by KISS-ICP alone; empty if it was not kept, or for another odometry."""
        return self._inner.alone() if isinstance(self._inner, KissOdometry) else ()

    def note(self, recorded: Step) -> None:
        """Note a recorded step; after `resume`, `track` continues from it."""
        motion = recorded.motion or Motion(MotionState.UNCHECKED)
        self._selector.update(recorded.T_odom_lidar, after_break=motion.is_break)
        self._last_stamp_ns = recorded.stamp_ns
        self._note_index(recorded.scan_index)

    def _note_index(self, index: int) -> None:
        self._indices.add(index)
        self._next_index = index + 1

    def resume(self, T_odom_lidar: Poses, stamps_ns: Indices, scan_of: Callable[[int], Scan]) -> None:
        """Continue after noted scans, with these poses and stamps; `scan_of` reads the scan of a row.

        The odometry starts again: it registers the last `RESUMED_SCANS` again, and its frame is placed so that the last
        pose stays. Poses of a drive with more scans differ from those of an uninterrupted run, usually by centimetres.
        """
        for row in range(max(len(T_odom_lidar) - RESUMED_SCANS, 0), len(T_odom_lidar)):
            scan = replace(scan_of(row), stamp_ns=int(stamps_ns[row]))
            T_own_lidar = self._odometry.register(scan).T_odom_lidar
        self._T_odom_own = geometry.nearest_transform(T_odom_lidar[-1] @ geometry.inverse(T_own_lidar))
