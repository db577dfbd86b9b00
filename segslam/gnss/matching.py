"""Fixes matched to a drive: where the sensor was, by the trajectory, at the time of each fix."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core.trajectory import Poses, nearest_rows, travelled_m
from segslam.core.types import Indices, Mask, Points, SegslamError, Vector
from segslam.gnss.fixes import Fixes
from segslam.gnss.geodesy import Origin, enu_from_geodetic

LONGEST_GAP_S = 2.0
"""Chosen: a fix farther than this from every scan has no pose."""
SPEED_OVER_S = 0.2
"""Chosen: time over which the velocity at a fix is measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A finished trajectory: the poses of all scans, some of which are keyframes."""

    stamp_ns: Indices
    """(n,) times of the scans (ns), ascending."""
    T_map_lidar: Poses
    """(n, 4, 4) poses of the scans in the map."""
    keyframe_rows: Indices
    """(k,) row of each keyframe in the two."""
    breaks: Sequence[int] = ()
    """Rows of the keyframes after a motion that is almost unknown, ascending."""

    @property
    def T_map_keyframe(self) -> Poses:  # noqa: N802  (a transform)
        """(k, 4, 4) poses of the keyframes in the map."""
        return self.T_map_lidar[self.keyframe_rows]


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """The fixes with a pose of the drive, a row for each, in the order of time."""

    drive: Drive
    rows: Indices
    """(n,) row of each in the `Fixes`."""
    time_s: Vector
    """(n,) time since the first scan (s), in the clock of the scans."""
    enu_m: Points
    """(n, 3) measured position, east, north, up; NaN for an unknown height."""
    keyframe: Indices
    """(n,) the keyframe nearest in time without a break between."""
    T_map_lidar: Poses
    """(n, 4, 4) pose of the LiDAR in the map at the time of the fix."""
    T_keyframe_lidar: Poses
    """(n, 4, 4) the same in that keyframe."""
    velocity: Points
    """(n, 3) velocity of the LiDAR in the map (m/s)."""
    travel_m: Vector
    """(n,) travel of the LiDAR at the time of the fix."""

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A drive and its fixes in the local frame, before they are matched for one offset of the clocks."""

    drive: Drive
    fixes: Fixes
    origin: Origin
    enu_m: Points
    """(n, 3) positions of all fixes; NaN for those that cannot be used."""

    def matched(self, offset_s: float) -> Matched:
        """The usable fixes within the time of the drive, after `offset_s` is added to their times."""
        drive = self.drive
        stamps = self.fixes.stamp_ns + round(1e9 * offset_s)
        rows = np.flatnonzero(self.fixes.usable & has_pose(drive, stamps))
        begin = int(drive.stamp_ns[0])
        time_s = 1e-9 * (stamps[rows] - begin)
        scan_s = 1e-9 * (drive.stamp_ns - begin)
        before = np.searchsorted(scan_s, time_s, side="right") - 1
        part_s = 2.0 * (scan_s[-1] + 1.0) * np.searchsorted(drive.breaks, np.arange(len(scan_s)), side="right")
        keyframe = nearest_rows((scan_s + part_s)[drive.keyframe_rows], time_s + part_s[before])
        T_map_lidar = interpolated(drive, scan_s, time_s)
        around_s = [np.clip(time_s + half_s, scan_s[0], scan_s[-1]) for half_s in (-SPEED_OVER_S / 2, SPEED_OVER_S / 2)]
        before, after = (
            np.column_stack([np.interp(moment_s, scan_s, axis) for axis in drive.T_map_lidar[:, :3, 3].T])
            for moment_s in around_s
        )
        return Matched(
            drive=drive,
            rows=rows,
            time_s=time_s,
            enu_m=self.enu_m[rows],
            keyframe=keyframe,
            T_map_lidar=T_map_lidar,
            T_keyframe_lidar=np.linalg.inv(drive.T_map_keyframe[keyframe]) @ T_map_lidar,
            velocity=(after - before) / np.maximum(around_s[1] - around_s[0], 1e-9)[:, None],
            travel_m=np.interp(time_s, scan_s, travelled_m(drive.T_map_lidar)),
        )


def prepare(fixes: Fixes, drive: Drive, *, offset_s: float = 0.0) -> Prepared:
    """The fixes in the local frame at the first one within the drive; its height is the first that is known, or 0.

    Raises SegslamError if no usable fix is within the time of the drive, with both times, and the offset that would
    help if one is obvious.
    """
    within = fixes.usable & has_pose(drive, fixes.stamp_ns + round(1e9 * offset_s))
    if not within.any():
        first, last = (1e-9 * (fixes.stamp_ns[fixes.usable][row]) + offset_s for row in (0, -1))
        begin, end = 1e-9 * drive.stamp_ns[0], 1e-9 * drive.stamp_ns[-1]
        raise SegslamError(
            f"{fixes.source}: its fixes are from {first:.1f} to {last:.1f} s, the scans from {begin:.1f} to {end:.1f} "
            "s: no fix is within the drive. If both are of one drive, give the difference of the clocks: --gnss-offset "
            f"{begin - first + offset_s:.1f} lets them begin together"
        )
    latitude, longitude = fixes.places[within][0, :2].tolist()
    has_height = np.isfinite(fixes.places[:, 2])
    heights = fixes.places[within & has_height, 2].tolist()
    origin = Origin(latitude, longitude, heights[0] if heights else 0.0)
    enu_m = enu_from_geodetic(np.where(np.isfinite(fixes.places), fixes.places, origin), origin)
    enu_m[~fixes.usable] = np.nan
    enu_m[~has_height, 2] = np.nan
    return Prepared(drive, fixes, origin, enu_m)


def has_pose(drive: Drive, stamp_ns: Indices) -> Mask:
    """(n,) True for times within the drive and near enough to a scan."""
    away = np.abs(stamp_ns - drive.stamp_ns[nearest_rows(drive.stamp_ns, stamp_ns)])
    inside = (stamp_ns >= drive.stamp_ns[0]) & (stamp_ns <= drive.stamp_ns[-1])
    return inside & (away <= 1e9 * LONGEST_GAP_S)


def interpolated(drive: Drive, scan_s: Vector, time_s: Vector) -> Poses:
    """(n, 4, 4) poses in the map at some times, between those of the two nearest scans."""
    row = np.clip(np.searchsorted(scan_s, time_s, side="right") - 1, 0, max(len(scan_s) - 2, 0))
    after = np.minimum(row + 1, len(scan_s) - 1)
    share = np.clip((time_s - scan_s[row]) / np.maximum(scan_s[after] - scan_s[row], 1e-9), 0.0, 1.0)
    poses = drive.T_map_lidar[row].copy()
    before = ScipyRotation.from_matrix(poses[:, :3, :3])
    motion = before.inv() * ScipyRotation.from_matrix(drive.T_map_lidar[after, :3, :3])
    poses[:, :3, :3] = (before * ScipyRotation.from_rotvec(share[:, None] * motion.as_rotvec())).as_matrix()
    poses[:, :3, 3] += share[:, None] * (drive.T_map_lidar[after, :3, 3] - poses[:, :3, 3])
    return poses
