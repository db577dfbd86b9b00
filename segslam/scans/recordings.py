"""Folders of scan files, rosbag, mcap and pcap recordings, and the data sets that kiss_icp reads.

The number of a scan is its position in the recording.
"""

import contextlib
import io
import logging
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from segslam.core.errors import brief
from segslam.core.pose_files import read_poses
from segslam.core.types import BadScan, SegslamError, Trajectory
from segslam.labels.label_files import open_labels
from segslam.scans.clouds import SUFFIXES, read_file
from segslam.scans.dataset import (
    Cloud,
    Dataset,
    DataSource,
    check_num_lines,
    dates_of_scans,
    no_topics,
    read_stamps,
    selected_rows,
)
from segslam.scans.named_stamps import stamps_of_names

logger = logging.getLogger(__name__)

ASSUMED_PERIOD_NS = 100_000_000  # 10 Hz, the rate of most LiDARs; used if there are no stamps
RAW = "velodyne_points"
"""Folder of KITTI's raw data, and of KITTI-360, with the scans in `data/` and their dates in `timestamps.txt`."""
KIND_OF_SUFFIX = {".mcap": "mcap", ".bag": "rosbag", ".db3": "rosbag", ".pcap": "ouster"}
ROOTS = {
    "apollo": ("pcds", "poses/gt_poses.txt"),
    "boreas": ("lidar", "applanix/lidar_poses.csv"),
    "helipr": ("LiDAR", "LiDAR_GT"),
    "mulran": ("Ouster", "global_pose.csv"),
    "ncd": ("raw_format/ouster_scan", "ground_truth/registered_poses.csv"),
    "nclt": ("velodyne_sync",),
}
"""Files and folders in the folder of a drive, by the reader of kiss_icp that reads it."""
REMEDIES = {
    **dict.fromkeys(ROOTS, "; or give the folder of the scans alone, if there are no true poses for them"),
    "mcap": "; `mcap recover IN -o OUT` copies what can be read",
    "helipr": "; give --sequence Ouster, Velodyne, Avia or Aeva",
    "rosbag": "; after a crash, `rosbag reindex FILE` (ROS 1) or `ros2 bag reindex FOLDER` (ROS 2) makes its index",
}
READ_HERE = {"generic": "", "boreas": "", "helipr": "", "ncd": "scan_folder", "nclt": "scans_dir"}
"""Kinds of data whose files are read here, with times and intensities. Except for the first, a reader of kiss_icp finds
them and the true poses: its attribute with the folder of the scans, if the names of files lack it."""
FOREIGN_ERRORS = (Exception, SystemExit)
"""Readers of other projects raise anything for damaged data; it becomes an error that names the file."""


class Recording(Dataset):
    """The selected scans of a recording. If it can only be read in order, going back restarts it."""

    def __init__(self, source: DataSource) -> None:
        """Raises SegslamError, with the error of the reader, if it cannot be opened or contains no scan."""
        kind, self._source, self._loader = _opened(source)
        self._kind = kind
        beside = _beside(self._source)
        self.name = f"{kind}/{beside.resolve().name}"
        self._has_intensities = source.intensities
        self.vertical_angle_deg = source.vertical_angle_deg or 0.0
        self.is_sequential = bool(getattr(self._loader, "is_sequential", False))
        self.num_recorded = len(self._loader)
        self._stamps = np.arange(self.num_recorded) * ASSUMED_PERIOD_NS
        files = [self._file(index) for index in range(self.num_recorded)]
        self._has_named_stamps = False
        times_file = beside / "times.txt"
        if kind == "generic" and times_file.exists():
            self._stamps = read_stamps(times_file)
            check_num_lines(times_file, len(self._stamps), self.num_recorded)
        elif hasattr(self._loader, "get_frames_timestamps"):
            times_s = np.asarray(self._loader.get_frames_timestamps(), dtype=float)
            self._stamps = np.rint(times_s.ravel() * 1e9).astype(np.int64)
        elif _is_raw(folder := files[0].parent.resolve()) and (folder.parent / "timestamps.txt").exists():
            self._stamps = dates_of_scans(folder.parent / "timestamps.txt", files)
        elif (named := stamps_of_names(files)) is not None:
            self._stamps, self._has_named_stamps = named, True
        self.scan_index = selected_rows(np.arange(self.num_recorded), source.frames, self._source)
        self.names = [files[index].stem for index in self.scan_index]
        self.labels = open_labels(source.labels, beside=beside, scan_names=self.names, encoding=source.encoding)
        poses_file = beside / "poses.txt"
        if kind == "generic" and poses_file.exists():
            poses = read_poses(poses_file, format="kitti").T_a_b
            check_num_lines(poses_file, len(poses), self.num_recorded)
        else:
            poses = np.asarray(getattr(self._loader, "gt_poses", np.empty((0, 4, 4))), dtype=float)
            if len(poses) not in (0, self.num_recorded):
                what = f"{len(poses)} true poses for {self.num_recorded} scans"
                logger.warning("%s: %s are not used; see `segslam eval --reference`", source.data, what)
                poses = poses[:0]
        self.reference = None
        if len(poses):
            self.reference = Trajectory(self.scan_index, self._stamps[self.scan_index], poses[self.scan_index])

    def _read(self, row: int) -> tuple[Path, int, Cloud]:
        """As in the base class; readers of kiss_icp give points, or points and times."""
        index = int(self.scan_index[row])
        file = self._file(index)
        try:
            item = read_file(file) if self._kind in READ_HERE else self._loader[index]
            if not isinstance(item, Cloud):
                item = Cloud(*item) if isinstance(item, tuple) else Cloud(item)
                if self._has_intensities or self.labels.network:
                    with contextlib.suppress(SegslamError):  # a file with another layout than KITTI's
                        item = replace(item, intensities=read_file(file).intensities)
            points = np.asarray(item.points).reshape(-1, 3)
            points = points if points.dtype == np.float32 else points.astype(np.float64)
            fits = item.intensities is not None and len(item.intensities) == len(points)
            times = np.asarray(item.times, dtype=np.float64).ravel()
            cloud = replace(item, points=points, times=times, intensities=item.intensities if fits else None)
            if self._has_named_stamps:
                cloud = replace(cloud, stamp_ns=int(self._stamps[index]))
        except BadScan:
            raise
        except FOREIGN_ERRORS as error:
            raise BadScan(f"{file}: the scan cannot be read ({_reason(error)})") from error
        stamps_ns = (cloud.stamp_ns, cloud.logged_ns, int(self._stamps[index]))
        stamp_ns = next(stamp for stamp in stamps_ns if stamp is not None)
        if abs(stamp_ns) >= 2**63:
            raise BadScan(f"{file}: its stamp {stamp_ns} ns is more than 292 years; correct the sensor's clock")
        return file, stamp_ns, cloud

    def _file(self, index: int) -> Path:
        """The file of a scan; a name with its number for recordings of many scans."""
        files = self._loader if self._kind == "generic" else getattr(self._loader, "scan_files", None)
        folder = Path(getattr(self._loader, READ_HERE.get(self._kind, ""), ""))
        return folder / str(files[index]) if files is not None else self._source / f"{index:06d}"


def scan_files(folder: Path) -> list[Path]:
    """The files with scans in a folder, without hidden ones, by the stamps or the numbers in their names.

    .npy files are scans only if no file has another format. Raises SegslamError for scans of several formats.
    """
    found = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")]
    files = [file for file in found if file.is_file()]
    files = [file for file in files if file.suffix.lower() != ".npy"] or files
    suffixes = [file.suffix.lower() for file in files]
    counts = {suffix: suffixes.count(suffix) for suffix in sorted(set(suffixes))}
    if len(counts) > 1:
        listed = ", ".join(f"{suffix} {count}" for suffix, count in counts.items())
        raise SegslamError(f"{folder}: {len(counts)} kinds of scans ({listed}); put each kind into its own folder")
    files.sort(key=_by_numbers)
    stamps = stamps_of_names(files)
    return files if stamps is None else [files[row] for row in np.argsort(stamps)]


def _by_numbers(file: Path) -> tuple[list[str | int], str]:
    """Texts and numbers of a name in turn: 10 comes after 9."""
    parts = re.split(r"(\d+)", file.name)
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], file.name


def _opened(source: DataSource) -> tuple[str, Path, Any]:
    """Kind of the data, file or folder with the scans, and their reader."""
    kinds = known_kinds()
    if source.dataset is not None and source.dataset not in kinds:
        raise SegslamError(f"--dataset {source.dataset}: no such kind of data; known: {', '.join(kinds)}")
    kind = source.dataset or _kind_of(source.data)
    if source.topic and kind not in ("mcap", "rosbag"):
        raise no_topics(source.topic)
    place = _scans_folder(source.data) if kind == "generic" else source.data
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings about kiss_icp's sources, which it parses to find its readers
            loader = _loader(kind, place, source.sequence, source.topic)
            num_scans = len(loader)
    except SegslamError:
        raise
    except FOREIGN_ERRORS as error:
        complaint = " ".join(printed.getvalue().split()) if isinstance(error, SystemExit) else _reason(error)
        remedy = REMEDIES.get(kind, "") if "mcap recover" not in complaint else ""
        what = f"cannot be opened as {kind} data ({complaint}); see --dataset{remedy}"
        raise SegslamError(f"{source.data}: {what}") from error
    if num_scans == 0:
        raise SegslamError(f"{source.data}: the reader for {kind} data finds no scan in it; see --dataset")
    return kind, place, loader


def _loader(kind: str, source: Path, sequence: str, topic: str) -> Any:
    """The reader of a kind of data: scans by number, or their files. Libraries are imported for their kind only."""
    match kind:
        case "generic":
            return scan_files(source)
        case "mcap" | "rosbag":
            from segslam.scans.messages import BagMessages, McapMessages
            from segslam.scans.point_cloud2 import MessageClouds

            return MessageClouds((McapMessages if kind == "mcap" else BagMessages)(source, topic))
        case "ouster":
            from segslam.scans.ouster import OusterFrames

            return OusterFrames(source)
    from kiss_icp.datasets import dataset_factory

    with contextlib.redirect_stderr(io.StringIO()):  # here alone: warnings of our own readers are for the user
        return dataset_factory(kind, source.resolve(), sequence=sequence, topic=topic)


def _kind_of(data: Path) -> str:
    if data.is_file() and (suffix := data.suffix.lower()) in KIND_OF_SUFFIX:
        if KIND_OF_SUFFIX[suffix] == "rosbag" and data.suffix != suffix:
            raise SegslamError(f"{data}: the extension of a bag is in small letters; rename it: {data.stem}{suffix}")
        return KIND_OF_SUFFIX[suffix]
    if (data / "metadata.yaml").exists() or any(data.glob("*.bag")):
        return "rosbag"
    if data.is_dir() and scan_files(_scans_folder(data)):
        return "generic"
    for kind, names in ROOTS.items():
        if all((data / name).exists() for name in names):
            return kind
    if files := sorted(file for suffix in ("db3", "mcap") for file in data.glob(f"*.{suffix}")):
        raise SegslamError(
            f"{data}: no metadata.yaml, as after a crash; `ros2 bag reindex {data}` makes that of a ROS 2 bag; or give "
            f"a file: {files[0]}"
        )
    files = [file for file in ([data] if data.is_file() else data.iterdir()) if file.is_file()]
    suffixes = sorted({file.suffix for file in files} - {"", *SUFFIXES})
    others = f" (only {' '.join(suffixes[:9])})" if suffixes else ""
    raise SegslamError(
        f"{data}: found neither sequences/ nor velodyne/ (KITTI), nor clouds (.bin .ply .pcd .npy), nor a rosbag, "
        f".mcap or .pcap{others}; give the folder that contains them, convert scans of another format to .npy, or give "
        "the kind by --dataset"
    )


def _scans_folder(data: Path) -> Path:
    """The folder itself, or that with the scans of KITTI's layouts below it."""
    if scan_files(data):
        return data
    below = ["data"] if data.resolve().name == RAW else ["velodyne", f"{RAW}/data"]
    return next((data / name for name in below if (data / name).is_dir()), data)


def _beside(scans: Path) -> Path:
    """The folder that has times, poses and labels of a folder of scans."""
    place = scans.resolve()
    if _is_raw(place):
        return place.parent.parent
    return place.parent if place.name == "velodyne" else scans


def _is_raw(folder: Path) -> bool:
    return folder.name == "data" and folder.parent.name == RAW


def _reason(error: BaseException) -> str:
    return brief(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__, 300)


def known_kinds() -> list[str]:
    """Names for `dataset`: kitti, and those of kiss_icp's readers."""
    from kiss_icp.datasets import available_dataloaders

    return sorted({"kitti", *available_dataloaders()})
