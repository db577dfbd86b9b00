"""What every reader of scans shares: the Protocol, the selection of scans, and the points that can be used."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from segslam.points import squared_ranges
from segslam.semantics.label_files import LabelSource
from segslam.trajectory import nanoseconds
from segslam.types import BadScan, Indices, Labels, Points, Scan, SegslamError, Trajectory, Transform, Vector

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
    def labels(self) -> LabelSource:
        """Where its labels come from."""
        ...

    @property
    def reference(self) -> Trajectory | None:
        """True poses of these scans, of those that have one; None if there is no ground truth."""
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
    labels: Labels,
    times: Vector = NO_TIMES,
    *,
    intensities: Vector | None = None,
) -> Scan:
    """The scan without its unusable points: those with a NaN or infinity, and those at the origin, which are no return.

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
        points, labels, times = points[kept], labels[kept], times[kept] if len(times) else times
        intensities = intensities if intensities is None else intensities[kept]
    if intensities is not None:
        intensities = np.ascontiguousarray(intensities, dtype=np.float32)
    return Scan(index, stamp_ns, np.ascontiguousarray(points, dtype=np.float32), labels, times, intensities)


def selected_rows(scan_index: Indices, frames: str | None, source: Path) -> Indices:
    """Rows of the scans whose number lies in `A:B` (A included, B not, either may be left out); all for None.

    Raises SegslamError for another form, and if no scan is left.
    """
    if frames is None:
        return np.arange(len(scan_index))
    first, colon, last = frames.partition(":")
    try:
        start, stop = int(first or 0), int(last or np.iinfo(np.int64).max)
    except ValueError:
        colon = ""
    if not colon:
        raise SegslamError(f"--frames {frames}: write it as A:B, scans A to B - 1, for example 0:100")
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
    stamps = []
    for number, line in enumerate(lines, start=1):
        try:
            stamps.append(nanoseconds(line))
        except ValueError as error:
            raise SegslamError(f"{file}:{number}: {error}; mend the line") from error
    return np.array(stamps, dtype=np.int64)
