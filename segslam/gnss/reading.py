"""Position fixes of any source that segslam reads."""

from pathlib import Path

from segslam.gnss.csv_fixes import read_csv
from segslam.gnss.fixes import Fixes, make_fixes
from segslam.gnss.text import text_lines


def read_fixes(source: str | Path, *, recording: Path | None = None) -> Fixes:
    """The fixes of a CSV file. Raises SegslamError, naming file and line, for anything else."""
    file = Path(source).expanduser()
    return make_fixes(file, read_csv(file, text_lines(file)))
