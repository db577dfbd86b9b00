"""The interface of all readers, the selection of scans, and the removal of invalid points."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from segslam.core.config import SensorCalibrationConfig, validated
from segslam.core.errors import brief, counted
from segslam.core.geometry import raise_beams
from segslam.core.points import squared_ranges
from segslam.core.stamps import dated_nanoseconds, nanoseconds
from segslam.core.types import BadScan, Indices, Points, Scan, ScanLabels, SegslamError, Trajectory, Transform, Vector
from segslam.core.whole_files import expanded, read_text
from segslam.labels.encodings import ENCODINGS, Encoding
from segslam.labels.label_files import LabelSource, of_rows
from segslam.scans.scan_files import sweep_of

logger = logging.getLogger(__name__)

NO_LIMIT = 2**63 - 1


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points of one scan, as its reader finds them: float32 if they are stored so, otherwise float64."""

    points: Points
    """(n, 3); NaN for beams without return."""
    times: Vector = field(default_factory=lambda: np.empty(0))
    """(n,) in any unit, from any origin; empty if there are none."""
    intensities: Vector | None = None
    """(n,) in the sensor's unit; None if there are none."""
    stamp_ns: int | None = None
    """None if the scan itself has no stamp, in a header or in its name."""
    logged_ns: int | None = None
    """When it was recorded, if it has no stamp."""


class Dataset:
    """Scans in order of time, each read when it is accessed; made by `DataSource.open`.

    `dataset[row]` raises BadScan for a scan that cannot be used; iteration skips such scans with a warning.
    """

    name: str
    """Name of the data for messages and logs, such as `kitti/00`."""
    scan_index: Indices
    """The number of each scan."""
    names: Sequence[str]
    """The name of each scan, which is also that of its label file."""
    is_sequential: bool = False
    """True if reading a scan requires reading those before it, as in a rosbag."""
    vertical_angle_deg: float
    """Angle by which the elevation of the points is increased on reading."""
    labels: LabelSource
    reference: Trajectory | None
    """True poses of those scans that have one; None if there is no ground truth."""
    num_recorded: int
    """Number of lines in a pose file of the whole data; line n + 1 belongs to scan n, selected or not."""
    T_camera_lidar: Transform | None = None
    """Transform if ground-truth files contain camera poses (KITTI); None if they contain LiDAR poses."""
    _has_intensities: bool

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {counted(len(self), 'scan')})"

    def __len__(self) -> int:
        return len(self.scan_index)

    def __getitem__(self, row: int) -> Scan:
        """The scan. Raises BadScan if it cannot be read or its labels cannot be used."""
        file, stamp_ns, cloud = self._read(row)
        return make_scan(
            file,
            int(self.scan_index[row]),
            stamp_ns,
            cloud,
            self.labels.read(file.stem, cloud.points, cloud.intensities),
            has_intensities=self._has_intensities,
            vertical_angle_deg=self.vertical_angle_deg,
        )

    def _read(self, row: int) -> tuple[Path, int, Cloud]:
        """The file of a scan, or a path with its name; its stamp (ns); and its cloud. Raises BadScan."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[Scan]:
        for row in range(len(self)):
            try:
                scan = self[row]
            except BadScan as error:
                logger.warning("scan %d skipped: %s", self.scan_index[row], error)
            else:
                yield scan


@dataclass(frozen=True, slots=True)
class DataSource:
    """Arguments of `open_dataset`, here or on another machine with the same files."""

    data: Path
    sequence: str = "00"
    dataset: str | None = None
    labels: str = "auto"
    encoding: Encoding | None = None
    frames: str | None = None
    topic: str = ""
    intensities: bool = False
    vertical_angle_deg: float | None = None

    def open(self) -> Dataset:
        """The data set, as `open_dataset` opens it; the folder of a run is none, though its map may be a scan file."""
        folder = expanded(self.data)
        if not folder.exists():
            raise SegslamError(f"{folder}: no such file or folder; give the folder with sequences/ or with the scans")
        if self.encoding not in (None, *ENCODINGS):
            raise SegslamError(f"encoding {self.encoding}: unknown; known: {', '.join(ENCODINGS)}")
        sensor = validated(SensorCalibrationConfig, {"vertical_angle_deg": self.vertical_angle_deg}, str(folder))
        source = replace(self, data=folder, vertical_angle_deg=sensor.vertical_angle_deg)
        from segslam.scans.kitti import KittiSequence, is_kitti

        try:
            if all((folder / name).is_file() for name in ("log.mcap", "config.yaml")):
                raise SegslamError(f"{folder}: the folder of a run; give the data that it was made from")
            if self.dataset == "kitti" or (self.dataset is None and is_kitti(folder)):
                if self.topic:
                    raise no_topics(self.topic)
                return KittiSequence(source)
            from segslam.scans.recordings import Recording  # with the libraries of recordings

            return Recording(source)
        except OSError as error:
            raise SegslamError(f"{folder}: cannot be read ({error}); check the path and its permissions") from error


def no_topics(topic: str) -> SegslamError:
    """An error for a topic of data that have none."""
    return SegslamError(f"--topic {topic}: only recordings have topics (rosbag, mcap); omit the option")


def make_scan(
    source: Path,
    index: int,
    stamp_ns: int,
    cloud: Cloud,
    labels: ScanLabels,
    *,
    has_intensities: bool = False,
    vertical_angle_deg: float = 0.0,
) -> Scan:
    """The scan without invalid points: those with a NaN or infinity, and those at the origin, which mean "no return".

    A distance whose square exceeds float32 (1.8e19 m) is infinite. This function alone applies `vertical_angle_deg`;
    label sources see the points as stored. Labels, times and intensities are reduced to the same points; the times of
    the others may be anything. Raises BadScan, naming `source`, if no point remains.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # wild numbers, and NaNs that signal
        points = cloud.points.astype(np.float32, copy=False)
        squared_range = squared_ranges(points)
    kept = np.isfinite(squared_range) & (squared_range > 0)
    if not kept.any():
        what = "has no points" if len(points) == 0 else f"none of its {len(points)} points is finite and not 0, 0, 0"
        raise BadScan(f"{source}: {what}; copy the file again, or leave this scan out")
    intensities = cloud.intensities if has_intensities else None
    measured = cloud.times[kept] if len(cloud.times) == len(points) else np.empty(0)
    stamp_s = (cloud.stamp_ns or stamp_ns) * 1e-9
    sweep = sweep_of(measured, int(kept.sum()), stamp_s, counts_from_stamp=bool(cloud.stamp_ns))
    if not kept.all():
        points, labels = points[kept], of_rows(labels, kept)
        intensities = None if intensities is None else intensities[kept]
    if intensities is not None:
        intensities = np.ascontiguousarray(intensities, dtype=np.float32)
    return Scan(
        np.ascontiguousarray(raise_beams(points, vertical_angle_deg)),
        stamp_ns,
        index,
        labels,
        sweep.times,
        intensities,
        None if kept.all() else kept,
        sweep.duration_s,
        sweep.stamp_time,
    )


def check_num_lines(file: Path, num_lines: int, num_recorded: int) -> None:
    """Raises SegslamError if a file of poses or times has another number of them than the data has scans."""
    if num_lines != num_recorded:
        raise SegslamError(
            f"{file}: {num_lines} lines, but the data has {num_recorded} scans; it must have one line per scan, line "
            "n + 1 for scan n. Correct or remove the file"
        )


def selected_rows(scan_index: Indices, frames: str | None, source: Path) -> Indices:
    """Rows of the scans with numbers in `A:B` (A included, B excluded; either may be omitted); all rows for None.

    Of `A:B:STEP`, the numbers A, A + STEP, ... are selected. Raises SegslamError for another form, and if no scan is
    selected.
    """
    if frames is None:
        return np.arange(len(scan_index))
    if not isinstance(frames, str):
        raise SegslamError(f"frames {frames!r}: give a text, 'A:B' for scans A to B - 1, for example '0:100'")
    first, last, step = (*frames.split(":"), "", "")[:3]
    if frames.count(":") not in (1, 2) or not all(text.strip().isdecimal() for text in (first, last, step) if text):
        raise SegslamError(f"--frames {frames}: write A:B, scans A to B - 1, or A:B:STEP, for example 0:100 or ::2")
    if step and int(step) == 0:
        raise SegslamError(f"--frames {frames}: STEP must be at least 1")
    start, stop = min(int(first or 0), NO_LIMIT), min(int(last or NO_LIMIT), NO_LIMIT)
    if start >= stop:
        raise SegslamError(f"--frames {frames}: selects no scan, B must be greater than A")
    if last and stop > scan_index[-1] + 1 and start <= scan_index[-1]:
        logger.warning("--frames %s: the last scan of %s is %d", frames, source, scan_index[-1])
    is_inside = (scan_index >= start) & (scan_index < stop)
    rows = np.flatnonzero(is_inside & ((scan_index - start) % min(int(step or 1), NO_LIMIT) == 0))
    if len(rows) == 0:
        raise SegslamError(f"--frames {frames}: {source} has no such scan, only {scan_index[0]} to {scan_index[-1]}")
    return rows


def read_stamps(file: Path) -> Indices:
    """Times (ns) from a file with one time in seconds per line; empty lines are ignored.

    Raises SegslamError, naming file and line.
    """
    text = read_text(file, "scan times", "expected one time in seconds per line")
    lines = [(number, line) for number, line in enumerate(map(str.strip, text.split("\n")), start=1) if line]
    stamps: list[int] = []
    for number, line in lines:
        try:
            stamp_ns = nanoseconds(line)
        except ValueError as error:
            raise SegslamError(f"{file}:{number}: {error}; correct the line") from error
        if stamp_ns < 0 or (stamps and stamp_ns <= stamps[-1]):
            before = brief(lines[len(stamps) - 1][1])
            wrong = "is negative" if stamp_ns < 0 else f"is not later than the previous line, {before}"
            raise SegslamError(f"{file}:{number}: {brief(line)} {wrong}; times must ascend and not be negative")
        stamps.append(stamp_ns)
    return np.array(stamps, dtype=np.int64)


def dates_of_scans(file: Path, scans: Sequence[Path]) -> Indices:
    """Times (ns) from a file with a date and time (UTC) per line; line n + 1 is that of the scan whose name is n.

    Raises SegslamError, naming file and line.
    """
    lines = read_text(file, "scan times", "expected a date and time per line").split("\n")
    stamps: list[int] = []
    for scan in scans:
        number = int(scan.stem) + 1 if scan.stem.isdecimal() else 0
        if not 1 <= number <= len(lines):
            raise SegslamError(f"{file}: has no line for {scan.name}; line n + 1 is the time of scan n")
        try:
            stamps.append(dated_nanoseconds(lines[number - 1].strip()))
        except ValueError as error:
            what = brief(lines[number - 1].strip())
            raise SegslamError(f"{file}:{number}: {what} is no date and time; correct the line") from error
    return np.array(stamps, dtype=np.int64)
