"""What every reader of scans shares: the Protocol, the selection of scans, and the points that can be used."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from segslam.geometry import raise_beams
from segslam.points import squared_ranges
from segslam.semantics.label_files import LabelSource
from segslam.semantics.late import of_rows
from segslam.trajectory import nanoseconds
from segslam.types import (
    BadScan,
    Indices,
    Points,
    Scan,
    ScanLabels,
    SegslamError,
    Trajectory,
    Transform,
    Vector,
)

logger = logging.getLogger(__name__)

ASSUMED_PERIOD_NS = 100_000_000  # most LiDARs turn at 10 Hz; used where nothing holds stamps
NO_TIMES = np.empty(0)


@runtime_checkable
class Dataset(Protocol):
    """Scans in order of time, each read when asked for.

    `dataset[row]` raises BadScan for a scan that cannot be used; iteration leaves those out, with a warning each.
    """

    @property
    def name(self) -> str:
        """For people and logs, such as `kitti/00`."""
        ...

    @property
    def scan_index(self) -> Indices:
        """The number of each scan."""
        ...

    @property
    def is_sequential(self) -> bool:
        """Whether reading a scan reads over those before it, as in a rosbag."""
        ...

    @property
    def names(self) -> Sequence[str]:
        """The name of each scan, which its file of labels has too."""
        ...

    @property
    def vertical_angle_deg(self) -> float:
        """The angle by which the points of its scans are raised on reading."""
        ...

    @property
    def labels(self) -> LabelSource:
        """Where its labels come from."""
        ...

    @property
    def reference(self) -> Trajectory | None:
        """True poses of these scans, of those that have one; None if there is no ground truth."""
        ...

    @property
    def num_recorded(self) -> int:
        """Lines of a file of poses for the whole data, where line n + 1 is of scan n; these may be some of them."""
        ...

    @property
    def T_camera_lidar(self) -> Transform | None:  # noqa: N802  (a transform)
        """Set where the files of ground truth hold the camera's poses instead of the LiDAR's (KITTI)."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, row: int) -> Scan: ...

    def __iter__(self) -> Iterator[Scan]: ...


def usable_scans(dataset: Dataset) -> Iterator[Scan]:
    """The scans in order; a bad one is left out with a warning."""
    for row in range(len(dataset)):
        try:
            scan = dataset[row]
        except BadScan as error:
            logger.warning("scan %d left out: %s", dataset.scan_index[row], error)
        else:
            yield scan


def make_scan(
    source: Path,
    index: int,
    stamp_ns: int,
    points: Points,
    labels: ScanLabels,
    times: Vector = NO_TIMES,
    *,
    intensities: Vector | None = None,
    vertical_angle_deg: float = 0.0,
) -> Scan:
    """The scan without its unusable points: those with a NaN or infinity, and those at the origin, which are no return.

    The points are raised by `vertical_angle_deg`, here and nowhere else: labels are read from points as stored.
    All that goes with them loses the same rows. Raises BadScan, naming `source`, if no point is left.
    """
    squared_range = squared_ranges(points)
    kept = np.isfinite(squared_range) & (squared_range > 0)
    if not kept.any():
        what = (
            "holds no point" if len(points) == 0 else f"none of its {len(points)} points is finite and off the origin"
        )
        raise BadScan(f"{source}: {what}; fetch the file again or leave the scan out with --frames")
    if not kept.all():
        points, labels, times = points[kept], of_rows(labels, kept), times[kept] if len(times) else times
        intensities = intensities if intensities is None else intensities[kept]
    if intensities is not None:
        intensities = np.ascontiguousarray(intensities, dtype=np.float32)
    return Scan(
        np.ascontiguousarray(raise_beams(points, vertical_angle_deg), dtype=np.float32),
        stamp_ns,
        index,
        labels,
        times,
        intensities,
        None if kept.all() else kept,
    )


def check_num_poses(file: Path, num_poses: int, num_recorded: int) -> None:
    """Raises SegslamError if a file of poses, a line a scan, is not of this data."""
    if num_poses != num_recorded:
        raise SegslamError(
            f"{file}: {num_poses} poses, but the data have {num_recorded}; it must have a line for each, line n + 1 "
            "for scan n. Correct or remove the file"
        )


def selected_rows(scan_index: Indices, frames: str | None, source: Path) -> Indices:
    """Rows of the scans whose number lies in `A:B` (A included, B not, either may be left out); all for None.

    Raises SegslamError for another form, and if no scan is left.
    """
    if frames is None:
        return np.arange(len(scan_index))
    first, colon, last = frames.partition(":")
    if not colon or not all(text.strip().isdecimal() for text in (first, last) if text):
        raise SegslamError(f"--frames {frames}: write it as A:B, scans A to B - 1, for example 0:100")
    start, stop = int(first or 0), int(last or np.iinfo(np.int64).max)
    if start >= stop:
        raise SegslamError(f"--frames {frames}: selects nothing, B must be greater than A")
    if last and stop > scan_index[-1] + 1 and start <= scan_index[-1]:
        logger.warning("--frames %s: the last scan of %s is %d", frames, source, scan_index[-1])
    rows = np.flatnonzero((scan_index >= start) & (scan_index < stop))
    if len(rows) == 0:
        raise SegslamError(f"--frames {frames}: {source} has no such scan, it has {scan_index[0]} to {scan_index[-1]}")
    return rows


def read_stamps(file: Path) -> Indices:
    """The times of a file, one a line in seconds, in nanoseconds. Raises SegslamError that names file and line."""
    try:
        lines = file.read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError) as error:
        raise SegslamError(
            f"{file}: cannot read the scans' times ({error}); it has seconds, one line a scan"
        ) from error
    stamps: list[int] = []
    for number, line in enumerate(lines, start=1):
        try:
            stamp_ns = nanoseconds(line)
        except ValueError as error:
            raise SegslamError(f"{file}:{number}: {error}; correct the line") from error
        if stamp_ns < 0 or (stamps and stamp_ns <= stamps[-1]):
            wrong = "is negative" if stamp_ns < 0 else f"is not later than the line before, {lines[number - 2]}"
            raise SegslamError(f"{file}:{number}: {line} {wrong}; times must rise from line to line, from 0 on")
        stamps.append(stamp_ns)
    return np.array(stamps, dtype=np.int64)
