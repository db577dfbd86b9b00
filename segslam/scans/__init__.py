"""Readers of scans from files and recordings, with one interface."""

from dataclasses import asdict, dataclass
from pathlib import Path

from segslam.core.paths import expanded
from segslam.core.types import SegslamError
from segslam.labels.encodings import Encoding
from segslam.scans.dataset import Dataset
from segslam.scans.kitti import is_kitti, open_kitti

__all__ = ["DataSource", "Dataset", "open_dataset"]


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
        """Raises SegslamError as `open_dataset` does."""
        return open_dataset(**asdict(self))


def open_dataset(
    data: str | Path,
    *,
    sequence: str = "00",
    dataset: str | None = None,
    labels: str = "auto",
    encoding: Encoding | None = None,
    frames: str | None = None,
    topic: str = "",
    intensities: bool = False,
    vertical_angle_deg: float | None = None,
) -> Dataset:
    """Open a folder or recording; its scans are read when they are accessed.

    `dataset`: kind of data (`kitti`, or a name of one of kiss_icp's readers), by default detected. `labels`: `auto`,
    `none`, `geometric`, `network:MODEL.onnx` or a folder. `frames`: numbers of the scans as `A:B` or `A:B:STEP`, B
    excluded. `topic`: point cloud topic of a recording with several. Scans have `intensities` only if requested and
    known.
    `vertical_angle_deg`: correction added to the elevation of all points; by default 0.205 degrees for data in KITTI's
    layout, whose points are too low by this angle, and 0 for other data. Raises SegslamError, naming the file and the
    remedy.
    """
    folder = expanded(data)
    if not folder.exists():
        raise SegslamError(f"{folder}: no such file or folder; give the folder with sequences/ or with the scans")
    try:
        if dataset == "kitti" or (dataset is None and is_kitti(folder)):
            if topic:
                raise SegslamError(f"--topic {topic}: only recordings have topics (rosbag, mcap); omit the option")
            return open_kitti(
                folder,
                sequence=sequence,
                labels=labels,
                encoding=encoding,
                frames=frames,
                intensities=intensities,
                vertical_angle_deg=vertical_angle_deg,
            )
        from segslam.scans.recordings import open_recording

        return open_recording(
            folder,
            kind=dataset,
            sequence=sequence,
            topic=topic,
            labels=labels,
            encoding=encoding,
            frames=frames,
            intensities=intensities,
            vertical_angle_deg=vertical_angle_deg or 0.0,
        )
    except OSError as error:
        raise SegslamError(f"{folder}: cannot be read ({error}); check the path and its permissions") from error
