"""Recordings read through kiss_icp's readers: folders of clouds, rosbag, mcap, pcap and other data sets.

The number of a scan is its position in the recording.
"""

import contextlib
import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError

from segslam.datasets.clouds import read_intensities
from segslam.datasets.kitti import read_returns
from segslam.datasets.mcap_clouds import McapClouds
from segslam.datasets.ouster import OusterFrames
from segslam.datasets.point_cloud2 import CloudReader
from segslam.datasets.scans import (
    ASSUMED_PERIOD_NS,
    check_num_poses,
    make_scan,
    read_stamps,
    selected_rows,
    usable_scans,
)
from segslam.datasets.sweep_times import sweep_times
from segslam.semantics.encodings import Encoding
from segslam.semantics.label_files import LabelSource, open_labels
from segslam.trajectory import read_poses
from segslam.types import BadScan, Indices, Scan, SegslamError, Trajectory, Vector

KIND_OF_SUFFIX = {".mcap": "mcap", ".bag": "rosbag", ".pcap": "ouster"}
READ_IN_ORDER = ("mcap", "rosbag")
"""Kinds of recordings that are read in order: the reader returns the next scan, whatever the index."""
LOADER_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    ImportError,
    LookupError,
    McapError,
    OSError,
    RuntimeError,
    StopIteration,
    SystemExit,
    TypeError,
    ValueError,
)
"""Exceptions that readers raise for missing or invalid data."""


class Recording:
    """The selected scans of a recording. If it can only be read in order, going back restarts it."""

    T_camera_lidar = None

    def __init__(
        self,
        kind: str,
        source: Path,
        loader: Any,
        *,
        labels: str,
        encoding: Encoding | None,
        frames: str | None,
        intensities: bool,
        vertical_angle_deg: float,
    ) -> None:
        beside = _beside(source)
        self.name = f"{kind}/{beside.resolve().name}"
        self._source = source
        self._loader = loader
        self._has_intensities = intensities
        self.vertical_angle_deg = vertical_angle_deg
        self.is_sequential = kind in READ_IN_ORDER
        self._clouds = CloudReader()
        if self.is_sequential:
            loader.read_point_cloud = self._clouds
        self._next = 0
        self._stamps = _whole_stamps(beside / "times.txt", len(loader)) if kind == "generic" else None
        self._is_folder = kind == "generic"
        self.num_recorded = len(loader)
        self.scan_index = selected_rows(np.arange(len(loader)), frames, source)
        self.names = [self._file(int(index)).stem for index in self.scan_index]
        self.labels: LabelSource = open_labels(labels, beside=beside, scan_names=self.names, encoding=encoding)
        self.reference = self._reference(beside / "poses.txt" if kind == "generic" else None)

    def __len__(self) -> int:
        return len(self.scan_index)

    def __getitem__(self, row: int) -> Scan:
        """The scan. Raises BadScan if kiss_icp's reader fails on it or its labels cannot be used."""
        index = int(self.scan_index[row])
        file = self._file(index)
        points, times = self._read(index, file)
        intensities = self._intensities(file, len(points))
        stamp_ns = self._stamp_ns(index)
        return make_scan(
            file,
            index,
            stamp_ns,
            points,
            self.labels.read(file.stem, points, intensities),
            sweep_times(times, len(points), stamp_ns * 1e-9),
            intensities=intensities if self._has_intensities else None,
            vertical_angle_deg=self.vertical_angle_deg,
        )

    def __iter__(self) -> Iterator[Scan]:
        return usable_scans(self)

    def _read(self, index: int, file: Path) -> tuple[np.ndarray, np.ndarray]:
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                self._go_to(index)
                is_bin = self._is_folder and file.suffix == ".bin"
                item = read_returns(file)[:, :3] if is_bin else self._loader[index]
            points, times = item if isinstance(item, tuple) else (item, np.empty(0))
            return np.asarray(points, dtype=np.float64).reshape(-1, 3), np.asarray(times, dtype=np.float64).ravel()
        except LOADER_ERRORS as error:
            raise BadScan(f"{file}: the scan cannot be read ({_reason(error)})") from error

    def _intensities(self, file: Path, num_points: int) -> Vector | None:
        """Intensities of the scan read last, if requested and known."""
        if not self._has_intensities and self.labels.network is None:
            return None
        known = self._clouds.intensities if self.is_sequential else getattr(self._loader, "intensities", None)
        if known is None and not self.is_sequential:
            with contextlib.suppress(BadScan):  # a .bin file with another layout than KITTI's
                known = read_intensities(file)
        return known if known is not None and len(known) == num_points else None

    def _go_to(self, index: int) -> None:
        """Skip the scans before `index`, if the recording can only be read in order."""
        if not self.is_sequential:
            return
        if index < self._next:
            self._loader.reset()
            self._next = 0
        while self._next < index:
            self._next += 1
            with contextlib.suppress(*LOADER_ERRORS):  # an invalid scan that is not selected
                self._loader[self._next - 1]
        self._next += 1

    def _stamp_ns(self, index: int) -> int:
        """Stamp of the scan that was read last; some readers know it only then."""
        if self._stamps is not None:
            return int(self._stamps[index])
        stamp_ns = self._clouds.stamp_ns or getattr(self._loader, "stamp_ns", 0)
        if stamp_ns:
            return stamp_ns
        if not hasattr(self._loader, "get_frames_timestamps"):
            return index * ASSUMED_PERIOD_NS
        seconds = self._loader.get_frames_timestamps()[-1 if self.is_sequential else index]
        return round(float(np.squeeze(seconds)) * 1e9)

    def _file(self, index: int) -> Path:
        """The file of a scan; a name with its number for recordings of many scans."""
        files = getattr(self._loader, "scan_files", None)
        return Path(str(files[index])) if files is not None else self._source / f"{index:06d}"

    def _reference(self, poses_file: Path | None) -> Trajectory | None:
        if poses_file is not None and poses_file.exists():
            poses = read_poses(poses_file, format="kitti").T_a_b
            check_num_poses(poses_file, len(poses), self.num_recorded)
        else:
            poses = np.asarray(getattr(self._loader, "gt_poses", np.empty((0, 4, 4))), dtype=float)
        posed = self.scan_index[self.scan_index < len(poses)]
        if len(posed) == 0:
            return None
        return Trajectory(posed, np.array([self._stamp_ns(int(index)) for index in posed]), poses[posed])


def open_recording(
    data: Path,
    *,
    kind: str | None,
    sequence: str,
    topic: str,
    labels: str,
    encoding: Encoding | None,
    frames: str | None,
    intensities: bool = False,
    vertical_angle_deg: float = 0.0,
) -> Recording:
    """A recording by the name of its kind in kiss_icp, or by detecting the kind from the file or folder.

    Raises SegslamError, with the error of the reader, if it cannot be opened or contains no scan.
    """
    from kiss_icp.datasets import available_dataloaders, dataset_factory

    kinds = sorted({"kitti", *available_dataloaders()})
    if kind is not None and kind not in kinds:
        raise SegslamError(f"--dataset {kind}: no such kind of data; known: {', '.join(kinds)}")
    kind = kind or _kind_of(data)
    if topic and kind not in READ_IN_ORDER:
        raise SegslamError(f"--topic {topic}: only recordings have topics (rosbag, mcap); omit the option")
    source = _scans_folder(data) if kind == "generic" else data
    if kind == "generic":
        _check_one_kind(source)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings about kiss_icp's sources, which it parses to find its readers
            if kind == "mcap":
                loader: Any = McapClouds(source, topic)
            elif kind == "ouster":
                loader = OusterFrames(source)
            else:
                loader = dataset_factory(kind, source, sequence=sequence, topic=topic)
            num_scans = len(loader)
    except LOADER_ERRORS as error:
        if isinstance(error, SystemExit) and kind == "generic":
            raise SegslamError(
                f"{source}: its first scan has no readable points x y z; copy the file again, or remove it"
            ) from error
        complaint = " ".join(printed.getvalue().split()) if isinstance(error, SystemExit) else _reason(error)
        raise SegslamError(f"{data}: cannot be opened as {kind} data ({complaint}); see --dataset") from error
    if num_scans == 0:
        raise SegslamError(f"{data}: the reader for {kind} data finds no scan in it; see --dataset")
    return Recording(
        kind,
        source,
        loader,
        labels=labels,
        encoding=encoding,
        frames=frames,
        intensities=intensities,
        vertical_angle_deg=vertical_angle_deg,
    )


def _kind_of(data: Path) -> str:
    if data.is_file() and data.suffix in KIND_OF_SUFFIX:
        return KIND_OF_SUFFIX[data.suffix]
    if (data / "metadata.yaml").exists() or any(data.glob("*.bag")):
        return "rosbag"
    if data.is_dir() and _has_clouds(_scans_folder(data)):
        return "generic"
    raise SegslamError(
        f"{data}: found neither sequences/ nor velodyne/ (KITTI), nor clouds (.bin .ply .pcd ...), nor a rosbag, .mcap "
        "or .pcap; give the folder that contains them, or the kind by --dataset"
    )


def _scans_folder(data: Path) -> Path:
    return data / "velodyne" if not _has_clouds(data) and (data / "velodyne").is_dir() else data


def _has_clouds(folder: Path) -> bool:
    from kiss_icp.datasets import supported_file_extensions

    suffixes = {f".{extension}" for extension in supported_file_extensions()}
    return any(file.suffix in suffixes for file in folder.iterdir())


def _check_one_kind(folder: Path) -> None:
    """Raises SegslamError for scans of several formats: only the first format would be read."""
    from kiss_icp.datasets import supported_file_extensions

    counts = {
        f".{extension}": sum(1 for file in folder.glob(f"*.{extension}") if file.is_file())
        for extension in supported_file_extensions()
    }
    found = {suffix: count for suffix, count in counts.items() if count}
    if len(found) > 1:
        listed = ", ".join(f"{suffix} {count}" for suffix, count in found.items())
        raise SegslamError(f"{folder}: {len(found)} kinds of scans ({listed}); put each kind into its own folder")


def _beside(source: Path) -> Path:
    """Folder in which the times, poses and labels of a folder of scans are searched."""
    return source.resolve().parent if source.resolve().name == "velodyne" else source


def _whole_stamps(times_file: Path, num_scans: int) -> Indices | None:
    if not times_file.exists():
        return None
    stamps = read_stamps(times_file)
    if len(stamps) != num_scans:
        raise SegslamError(f"{times_file}: {len(stamps)} lines for {num_scans} scans; correct or remove the file")
    return stamps


def _reason(error: BaseException) -> str:
    if "positions" in str(error):
        return "no fields x y z"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
