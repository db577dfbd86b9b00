"""Scans of data sets whose .bin files are not like KITTI's, known by the names of their files and folders.

nuScenes (`*.pcd.bin`), Boreas (`lidar/` beside `applanix/`), HeLiPR (`LiDAR/Ouster/` and others), NCLT
(`velodyne_sync/`), Oxford RobotCar (`velodyne_left/`, `velodyne_right/`); the layouts are those of their own readers.
"""

from pathlib import Path

import numpy as np

from segslam.scans.scan_files import NO_POINTS, Columns, read_bytes

POINT = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
RETURN = [*POINT, ("intensity", "<f4")]
NUSCENES = [*RETURN, ("ring", "<f4")]
BOREAS = [*NUSCENES, ("time", "<f4")]
NCLT = [("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("laser", "u1")]
NCLT_SCALE_M, NCLT_OFFSET_M = 0.005, -100.0
HELIPR = {
    "Ouster": [*RETURN, ("t", "<u4"), ("reflectivity", "<u2"), ("ring", "<u2"), ("ambient", "<u2")],
    "Velodyne": [*RETURN, ("ring", "<u2"), ("time", "<f4")],
    "Avia": [*POINT, ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"), ("offset_time", "<u4")],
    "Aeva": [*POINT, ("reflectivity", "<f4"), ("velocity", "<f4"), ("t", "<i4"), ("line", "u1"), ("intensity", "<f4")],
}
LAST_WITHOUT_INTENSITY_NS = 1_691_936_557_946_849_179
"""Stamp of the last scan of HeLiPR's Aeva whose points have no intensity."""
ROBOTCAR = ("velodyne_left", "velodyne_right")
"""Folders with all x of a scan first, then all y, z and intensities."""


def read_records(file: Path) -> Columns | None:
    """The fields of the points, with z up; None for the file of another data set.

    Raises BadScan if it cannot be read, ValueError if it has no points, or a part of one.
    """
    folder = file.resolve().parent
    if (layout := _layout(file, folder)) is None:
        return None
    kind, content = np.dtype(layout), read_bytes(file)
    if not content:
        raise ValueError(NO_POINTS)
    if len(content) % kind.itemsize:
        what = f"{len(content)} bytes are not a multiple of {kind.itemsize} ({' '.join(kind.names or ())})"
        raise ValueError(f"{what}: it is truncated, or not as the data set has it")
    if folder.name in ROBOTCAR:
        columns = dict(zip(kind.names or (), np.frombuffer(content, "<f4").reshape(4, -1), strict=True))
    else:
        rows = np.frombuffer(content, kind)
        columns = {name: rows[name] for name in kind.names or ()}
    if folder.name == "velodyne_sync":
        columns |= {axis: NCLT_SCALE_M * columns[axis] + NCLT_OFFSET_M for axis in "xyz"}
    if folder.name in ("velodyne_sync", *ROBOTCAR):  # stored with y to the right and z down
        columns |= {axis: -columns[axis] for axis in "yz"}
    return columns


def _layout(file: Path, folder: Path) -> list[tuple[str, str]] | None:
    """Names and types of the values of a point, in the order of the file; None if they are like KITTI's."""
    if file.name.endswith(".pcd.bin"):
        return NUSCENES
    if not (file.stem.isdecimal() and len(file.stem) >= 16):  # a stamp in us or ns
        return None
    if folder.parent.name == "LiDAR" and folder.name in HELIPR:
        has_all = folder.name != "Aeva" or int(file.stem) > LAST_WITHOUT_INTENSITY_NS
        return HELIPR[folder.name][: None if has_all else -1]
    if folder.name == "lidar" and (folder.parent / "applanix").is_dir():
        return BOREAS
    return {"velodyne_sync": NCLT, **dict.fromkeys(ROBOTCAR, RETURN)}.get(folder.name)
