"""Front end of the pipeline: odometry, its check, and selection of keyframes. It uses no graph and no log."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from segslam.candidates.proximity import BREAK_TRAVEL_M
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.stopwatch import Stopwatch
from segslam.core.trajectory import Poses
from segslam.core.types import BadScan, Indices, Motion, MotionState, Scan, Step, Transform
from segslam.keyframes.keyframes import KeyframeSelector
from segslam.odometry.checked import CheckedOdometry
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.motion_model import Intervals
from segslam.odometry.sweep import Odometry, OdometryResult, deskew_scan
from segslam.verification import register


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
        self._num_tracked = 0
        self._last_stamp_ns: int | None = None

    def track(self, scan: Scan, *, gap: float = 1.0) -> Tracked:
        """Estimate the pose of a scan, and decide whether it becomes a keyframe.

        `gap`: time since the previous scan in intervals of the sensor; above 1 if scans between them were lost. It
        scales the constant-velocity prediction of the odometry. Raises BadScan, and ignores the scan, if it cannot be
        used or is not later than the previous scan.
        """
        self._check_later(scan)
        index = self._num_tracked if scan.index is None else scan.index
        scan = replace(scan, index=index)
        watch = Stopwatch()
        with watch("odometry"):
            registered = self._odometry.register(scan, gap=gap)
        self._last_stamp_ns = scan.stamp_ns
        self._num_tracked += 1
        T_odom_lidar = registered.T_odom_lidar
        motion = registered.motion or Motion(MotionState.UNCHECKED)
        is_keyframe = self._selector.update(T_odom_lidar, break_m=BREAK_TRAVEL_M * motion.is_break)
        kept = registered if is_keyframe else None
        return Tracked(index, scan.stamp_ns, kept, T_odom_lidar, self._selector.travel_m, motion, watch)

    def alone(self) -> Sequence[Transform]:
        """The pose of each tracked scan by KISS-ICP alone; empty if it was not kept, or for another odometry."""
        return self._inner.alone() if isinstance(self._inner, KissOdometry) else ()

    def note(self, recorded: Step) -> None:
        """Note a recorded step; after `resume`, `track` continues from it."""
        motion = recorded.motion or Motion(MotionState.UNCHECKED)
        self._selector.update(recorded.T_odom_lidar, break_m=BREAK_TRAVEL_M * motion.is_break)
        self._last_stamp_ns = recorded.stamp_ns
        self._num_tracked = recorded.scan_index + 1

    def resume(self, T_odom_lidar: Poses, stamps_ns: Indices, scan_of: Callable[[int], Scan]) -> None:
        """Continue after scans with these poses and stamps; `scan_of` reads the scan of a row.

        The odometry starts from the last scans within its range, a keyframe's distance apart. Its poses
        therefore differ from those of an uninterrupted run, by centimetres to decimetres.
        """
        config = self._config
        intervals = Intervals()
        for stamp_ns in stamps_ns[:-1]:
            intervals.note(int(stamp_ns))
        gap = intervals.gap(int(stamps_ns[-1]))

        def motion_to(row: int) -> Transform:
            return geometry.inverse(T_odom_lidar[row - 1]) @ T_odom_lidar[row] if row > 0 else np.eye(4)

        rows = [len(T_odom_lidar) - 1]
        for row in reversed(range(len(T_odom_lidar) - 1)):
            if geometry.distance(geometry.inverse(T_odom_lidar[row]) @ T_odom_lidar[-1]) > config.odometry.max_range_m:
                break
            T_row_kept = geometry.inverse(T_odom_lidar[row]) @ T_odom_lidar[rows[-1]]
            if geometry.distance(T_row_kept) >= config.keyframes.distance_m:
                rows.append(row)
        read = {row: scan_of(row) for row in reversed(rows)}
        scans = [
            (T_odom_lidar[row], deskew_scan(scan, motion_to(row - 1), config.odometry)[0]) for row, scan in read.items()
        ]
        T_before_lidar = geometry.scaled(motion_to(rows[0]), 1.0 / gap)
        self._odometry.follow(scans, T_odom_lidar[-1], T_before_lidar, last=read[rows[0]])

    def _check_later(self, scan: Scan) -> None:
        if self._last_stamp_ns is not None and scan.stamp_ns <= self._last_stamp_ns:
            raise BadScan(
                f"scan {scan.index}: its stamp {scan.stamp_ns} ns is not later than that of the previous scan, "
                f"{self._last_stamp_ns} ns; give each scan once, in order of time"
            )
