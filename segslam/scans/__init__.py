"""Readers of scans from files and recordings, with one interface."""

from pathlib import Path

from segslam.core.whole_files import expanded
from segslam.labels.encodings import Encoding
from segslam.scans.dataset import Dataset, DataSource

__all__ = ["DataSource", "Dataset", "open_dataset"]


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
    return DataSource(
        expanded(data), sequence, dataset, labels, encoding, frames, topic, intensities, vertical_angle_deg
    ).open()
