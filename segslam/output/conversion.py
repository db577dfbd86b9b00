"""Trajectories of other tools: KITTI, TUM and CSV files, in the camera or in the LiDAR frame."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from segslam.core.errors import SegslamError
from segslam.core.pose_files import PoseFile, read_poses, write_kitti, write_tum
from segslam.core.trajectory import Poses, camera_from_lidar, lidar_from_camera
from segslam.core.types import Indices
from segslam.core.whole_files import whole_file
from segslam.scans.dataset import read_stamps
from segslam.scans.kitti import read_calibration

FileFormat = Literal["kitti", "tum", "csv"]
Frame = Literal["camera", "lidar"]
FORMATS: dict[str, FileFormat] = {".csv": "csv", ".tum": "tum", ".kitti": "kitti"}
HEADER = "seconds,x,y,z,qx,qy,qz,qw"
"""First line of a CSV file: the columns of TUM format, with commas."""


def convert(
    source: Path,
    target: Path,
    *,
    source_format: FileFormat | None = None,
    target_format: FileFormat | None = None,
    times: Path | None = None,
    calib: Path | None = None,
    to: Frame | None = None,
) -> int:
    """Write the poses of a file in another format; returns their number.

    Formats are found from the columns of the source and from the name of the target (`.csv`, `.tum`; otherwise KITTI,
    or TUM if the source has stamps). `times`: KITTI's times.txt, for a source without stamps. With `to`, poses of the
    camera become those of the LiDAR or back, by the `calib` of KITTI's calib.txt; the first LiDAR pose stays the origin
    if the first camera pose is. Raises SegslamError, naming the file and the remedy.
    """
    if (calib is None) != (to is None):
        raise SegslamError("--calib and --to-frame belong together: the calibration, and camera or lidar")
    kind: FileFormat | None = source_format or ("csv" if source.suffix.lower() == ".csv" else None)
    read = read_poses(source, format="tum" if kind == "csv" else kind, skips_names=kind == "csv")
    poses = _with_stamps(read, source, times)
    if calib is not None:
        T_camera_lidar = read_calibration(calib)
        moved = lidar_from_camera if to == "lidar" else camera_from_lidar
        poses = replace(poses, T_a_b=moved(poses.T_a_b, T_camera_lidar))
    written_as = target_format or FORMATS.get(target.suffix.lower(), "kitti" if poses.stamp_ns is None else "tum")
    with whole_file(target) as part:
        if written_as == "kitti":
            write_kitti(part, poses.T_a_b)
        elif poses.stamp_ns is None:
            raise SegslamError(
                f"{source}: has no stamps, which {written_as} needs; give KITTI's times.txt with --times"
            )
        else:
            (write_tum if written_as == "tum" else write_csv)(part, poses.stamp_ns, poses.T_a_b)
    return len(poses)


def write_csv(path: Path, stamp_ns: Indices, T_a_b: Poses) -> None:
    """Write a line of column names, then the columns of TUM format with commas; stamps to the nanosecond."""
    write_tum(path, stamp_ns, T_a_b)
    path.write_text(f"{HEADER}\n{path.read_text(encoding='ascii').replace(' ', ',')}", encoding="ascii")


def _with_stamps(poses: PoseFile, source: Path, times: Path | None) -> PoseFile:
    if times is None:
        return poses
    if poses.stamp_ns is not None:
        raise SegslamError(f"--times {times}: {source} has stamps of its own; omit the option")
    stamps = read_stamps(times)
    if len(stamps) != len(poses):
        raise SegslamError(f"{times}: {len(stamps)} times, but {source} has {len(poses)} poses; give the times of it")
    return replace(poses, stamp_ns=stamps)
