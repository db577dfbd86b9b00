"""The scans in the local maps of an interrupted run, reconstructed from its recorded motions."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from segslam.health.history import LOST_SCANS, History
from segslam.health.local_map import Fit, LocalMap
from segslam.trajectory import Poses
from segslam.types import Motion, MotionState


@dataclass(frozen=True, slots=True)
class RowsInMaps:
    """Rows of the scans in each local map, oldest first."""

    now: list[int]
    lost: list[int] | None
    """Rows in the map before a break, as long as scans are tried against it."""
    followed: tuple[int, list[int]] | None
    """The last row at which the inner odometry was set to another pose, and the rows in the map then."""


def rows_in_maps(
    T_odom_lidar: Poses,
    motions: Sequence[Motion],
    *,
    history: History,
    empty: Callable[[], LocalMap],
    map_scans: int,
) -> RowsInMaps:
    """Repeat the decisions of `CheckedOdometry` from its poses and motions, one row each; `history` is updated.

    `empty` makes an empty local map for up to `map_scans` scans.
    """
    nothing = np.empty((0, 3), np.float32)
    local, rows = empty(), deque[int](maxlen=map_scans)
    lost: tuple[LocalMap, deque[int]] | None = None
    followed: tuple[int, list[int]] | None = None
    for row, motion in enumerate(motions):
        if row > 0 and motion.state == MotionState.UNCHECKED:
            continue
        restarts = motion.state == MotionState.BROKEN and motion.rms_m is None
        is_registered = motion.rms_m is not None or restarts
        if row > 0 and not is_registered:
            history.note_moved(motion.moved_m or 0.0, np.radians(motion.moved_deg or 0.0), motion.overlap or 0.0)
        if is_registered and not history.is_watching:
            history.watch()
        if is_registered and lost is not None:
            history.scans_lost += 1
        if motion.state == MotionState.REJOINED and lost is not None:
            (local, rows), lost = lost, None
        elif restarts:
            if lost is None:
                lost, history.scans_lost = (local, rows), 0
            local, rows = empty(), deque[int](maxlen=map_scans)
            history.watch()
        elif lost is not None and history.scans_lost >= LOST_SCANS:
            lost = None
        if motion.rms_m is not None:
            fit = Fit(motion.overlap or 0.0, motion.rms_m)
            history.note_registration(motion.moved_m or 0.0, np.radians(motion.moved_deg or 0.0), fit)
        if motion.state == MotionState.BROKEN:
            history.watch()
        if local.add(T_odom_lidar[row], nothing, nothing):
            rows.append(row)
        if is_registered and motion.state != MotionState.CONFIRMED:
            followed = row, list(rows)
    return RowsInMaps(list(rows), None if lost is None else list(lost[1]), followed)
