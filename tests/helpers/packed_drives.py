"""Real drives that are stored packed, as folders of scans."""

import subprocess
import sys
from pathlib import Path

from segslam.scans import Dataset, open_dataset


def opened(data_dir: Path, drive: str, folder: Path) -> Dataset:
    """The scans of a real drive without labels; a packed one is written to a folder first."""
    source = data_dir / drive
    if (source / "unpack.py").exists():
        subprocess.run([sys.executable, "unpack.py", folder / drive], cwd=source, check=True)
        source = folder / drive
    return open_dataset(source, labels="none")
