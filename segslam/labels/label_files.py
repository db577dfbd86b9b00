"""Labels from `.label` files (SemanticKITTI): one file per scan, named like the scan, in any of the encodings.

A network's labels are computed on first use: it is slow, and only keyframes need labels.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from segslam.core.errors import unreadable
from segslam.core.types import BadScan, Label, Labels, Mask, Points, ScanLabels, SegslamError, Vector
from segslam.core.whole_files import expanded, whole_file
from segslam.labels.encodings import Encoding, Ids, detect_encoding, to_ids, to_labels

if TYPE_CHECKING:
    from segslam.labels.network import Network

logger = logging.getLogger(__name__)

NETWORK = "network:"


@dataclass(frozen=True, slots=True)
class LabelSource:
    """The source of the labels of a drive: a folder of `.label` files, named like the scans; a network; or none."""

    geometric: bool
    """True if scans without a label file are labelled by geometry when they become keyframes."""
    folder: Path | None = None
    encoding: Encoding | None = None
    """That of the files; known if there is a folder."""
    network: "Network | None" = None

    def read(self, name: str, points: Points, intensities: Vector | None = None) -> ScanLabels:
        """The labels of the scan `name`; all UNLABELLED if there is no source for it, or no file.

        `points` and `intensities` are in the order of the scan file. The labels of a network are computed when they are
        first used; that call raises SegslamError like `Network.labels`, and zeros replace unknown intensities. Raises
        BadScan as `read_labels`.
        """
        if self.network:
            if intensities is None:
                _warn_of_zeros()
                intensities = np.zeros(len(points))
            network, known = self.network, intensities
            return lambda: network.labels(points, known)
        file = self.folder / f"{name}.label" if self.folder else None
        if file is None or self.encoding is None or not file.exists():
            return unlabelled(len(points))
        return read_labels(file, len(points), self.encoding)


def whole_source(source: str, folder: Path = Path()) -> str:
    """The value of `--labels` for use elsewhere: a relative network starts at `folder`, by default the present one."""
    if not source.startswith(NETWORK):
        return source
    return NETWORK + str((folder / expanded(source.removeprefix(NETWORK))).resolve())


def open_labels(source: str, *, beside: Path, scan_names: Sequence[str], encoding: Encoding | None) -> LabelSource:
    """Open the value of `--labels`: `auto`, `none`, `geometric`, `network:MODEL.onnx`, or a folder of `.label` files.

    Relative folders start at `beside`, where `auto` looks for `labels/`; without such a folder, `auto` is `geometric`.
    Raises SegslamError for a folder that is missing or labels none of the scans, for files whose encoding is neither
    given nor detectable, and for a network that `Network` rejects.
    """
    if not isinstance(source, str):
        raise SegslamError(f"labels {source!r}: give a text: auto, none, geometric, network:MODEL.onnx or a folder")
    has_files = source not in ("none", "geometric") and not source.startswith(NETWORK)
    if encoding and not has_files:
        raise SegslamError(f"--encoding {encoding}: only label files have one; omit it with --labels {source}")
    if source in ("none", "geometric"):
        return LabelSource(source == "geometric")
    if not has_files:
        from segslam.labels.network import Network

        return LabelSource(False, network=Network(expanded(source.removeprefix(NETWORK))))
    folder = beside / ("labels" if source == "auto" else expanded(source))
    if source != "auto" and not folder.is_dir():
        where = f"no folder {folder} (a relative path starts beside the scans)"
        raise SegslamError(f"--labels {source}: {where}; give one, auto, none, geometric or network:MODEL")
    files = [file for name in scan_names if (file := folder / f"{name}.label").is_file()]
    if not files and source == "auto":
        return LabelSource(True)
    if not files:
        raise SegslamError(
            f"{folder}: no .label file for any of the {len(scan_names)} scans; label files are named like the scans"
        )
    if len(files) < len(scan_names):
        logger.warning("%s: %d of %d scans have no label file", folder, len(scan_names) - len(files), len(scan_names))
    spread = np.unique(np.linspace(0, len(files) - 1, 8).astype(int))  # chosen: so many files show it
    return LabelSource(source == "auto", folder, encoding or encoding_of([files[row] for row in spread]))


def read_ids(file: Path) -> Ids:
    """The class ids of a `.label` file: the lower 16 bits; the upper are instances. Raises BadScan if it is invalid."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise BadScan(unreadable(file, "labels", error)) from error
    if len(content) % 4:
        raise BadScan(f"{file}: {len(content)} bytes are not a multiple of 4 (uint32): truncated; copy the file again")
    return np.frombuffer(content, dtype="<u4") & 0xFFFF


def read_labels(file: Path, num_points: int, encoding: Encoding) -> Labels:
    """The labels of a scan of `num_points` points.

    Raises BadScan if the file is missing or invalid, has another number of labels, or ids outside the encoding.
    """
    ids = read_ids(file)
    if len(ids) != num_points:
        raise BadScan(f"{file}: {len(ids)} labels for {num_points} points; the labels are those of another scan")
    try:
        return to_labels(ids, encoding)
    except SegslamError as error:
        raise BadScan(f"{file}: {error}") from error


def write_labels(file: Path, labels: Labels, kept: Mask | None, encoding: Encoding) -> None:
    """Write the labels of a scan. Points of the scan file that are not `kept` become unlabelled.

    Raises SegslamError, naming the file, for a label that the encoding does not contain, and on a write error.
    """
    if kept is not None:
        whole = unlabelled(len(kept))
        whole[kept] = labels
        labels = whole
    try:
        ids = to_ids(labels, encoding).astype("<u4")
    except SegslamError as error:
        raise SegslamError(f"{file}: {error}") from error
    with whole_file(file) as part:
        ids.tofile(part)


def encoding_of(files: Sequence[Path]) -> Encoding:
    """The encoding of label files, detected from all of them. Raises SegslamError if it is ambiguous or unknown."""
    num_points_of_id = np.zeros(2**16, np.int64)
    why = "no file has a label; give the .label files of the scans"
    for file in files:
        try:
            num_points_of_id += np.bincount(read_ids(file), minlength=2**16)
        except BadScan as error:  # if other files are valid, it is reported when its scan is read
            why = str(error)
    where = files[0].parent if len(files) > 2 else " and ".join(str(file) for file in files)
    if not num_points_of_id.any():
        raise SegslamError(f"{where}: the numbering of the classes cannot be detected: {why}")
    try:
        return detect_encoding(num_points_of_id)
    except SegslamError as error:
        raise SegslamError(f"{where}: {error}") from error


def unlabelled(num_points: int) -> Labels:
    """UNLABELLED for each point."""
    return np.full(num_points, Label.UNLABELLED, dtype=np.uint8)


@cache
def _warn_of_zeros() -> None:
    """Warn once, not for every scan."""
    logger.warning("the data contain no readable intensities; the network receives zeros instead")


def computed(labels: ScanLabels) -> Labels:
    """The labels, computed now if necessary."""
    return labels() if callable(labels) else labels


def of_rows(labels: ScanLabels, rows: Mask) -> ScanLabels:
    """The labels of some rows; labels that are computed on first use stay so."""
    if callable(labels):
        return lambda: labels()[rows]
    return labels[rows]
