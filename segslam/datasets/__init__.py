"""Scans from files, one reader a family of data, behind one Protocol."""

from pathlib import Path

from segslam.datasets.kitti import is_kitti, open_kitti
from segslam.datasets.scans import Dataset
from segslam.semantics.encodings import Encoding
from segslam.types import SegslamError

__all__ = ["Dataset", "open_dataset"]


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
    """The scans of a folder or recording, read one by one when asked for.

    `dataset` is the kind of data (`kitti`, or a name of kiss_icp's readers), found from the folder where it can be;
    `labels` a source as `auto`, `none`, `geometric` or a folder; `frames` the scans as `A:B` by number, B not included;
    `topic` that of the points in a recording with several. Scans have `intensities` only if these are asked for, and
    known. Their points are raised by `vertical_angle_deg`; None: by 0.205 degrees for data in KITTI's layout, whose
    points lie too low by that, and not for other data. Raises SegslamError that names the file and the remedy.
    """
    folder = Path(data).expanduser()
    if not folder.exists():
        raise SegslamError(f"{folder}: no such file or folder; name the folder with sequences/ or with the scans")
    try:
        if dataset == "kitti" or (dataset is None and is_kitti(folder)):
            if topic:
                raise SegslamError(f"--topic {topic}: only recordings have topics (rosbag, mcap); leave the option out")
            return open_kitti(
                folder,
                sequence=sequence,
                labels=labels,
                encoding=encoding,
                frames=frames,
                intensities=intensities,
                vertical_angle_deg=vertical_angle_deg,
            )
        from segslam.datasets.recordings import open_recording

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
