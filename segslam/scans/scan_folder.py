"""A folder with one file per scan, in the order of their names."""

import re
from pathlib import Path

from segslam.core.types import SegslamError
from segslam.scans.clouds import SUFFIXES, read_file
from segslam.scans.dataset import Cloud


class ScanFolder:
    """The scans of a folder: all files of one format, without hidden ones. Numbers in names are sorted by value."""

    is_sequential = False

    def __init__(self, folder: Path) -> None:
        self.scan_files = scan_files(folder)

    def __len__(self) -> int:
        return len(self.scan_files)

    def __getitem__(self, index: int) -> Cloud:
        """Raises BadScan, naming the file."""
        return read_file(self.scan_files[index])


def scan_files(folder: Path) -> list[Path]:
    """The files with scans in a folder; .npy files are scans only if no file has another format.

    Raises SegslamError for scans of several formats.
    """
    found = [file for file in folder.iterdir() if file.suffix in SUFFIXES and not file.name.startswith(".")]
    files = [file for file in found if file.is_file()]
    files = [file for file in files if file.suffix != ".npy"] or files
    counts = {suffix: sum(file.suffix == suffix for file in files) for suffix in sorted({f.suffix for f in files})}
    if len(counts) > 1:
        listed = ", ".join(f"{suffix} {count}" for suffix, count in counts.items())
        raise SegslamError(f"{folder}: {len(counts)} kinds of scans ({listed}); put each kind into its own folder")
    return sorted(files, key=_by_numbers)


def _by_numbers(file: Path) -> tuple[list[str | int], str]:
    """Texts and numbers of a name in turn: 10 comes after 9."""
    parts = re.split(r"(\d+)", file.name)
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], file.name
