"""Position fixes of any source: the kind is found from the content."""

from pathlib import Path

from segslam.core.types import SegslamError
from segslam.gnss.csv_fixes import read_csv
from segslam.gnss.fixes import Fixes, make_fixes
from segslam.gnss.messages import read_messages
from segslam.gnss.nmea import is_nmea, read_nmea
from segslam.gnss.oxts import read_oxts
from segslam.gnss.rtklib import is_rtklib, read_rtklib
from segslam.gnss.text import text_lines

RECORDINGS = (".bag", ".mcap", ".db3")


def read_fixes(source: str | Path, *, recording: Path | None = None) -> Fixes:
    """The fixes of a CSV, NMEA or RTKLIB file, an oxts folder, a recording, or a topic of `recording`.

    Raises SegslamError, naming file and line, if they cannot be read.
    """
    path = Path(source).expanduser()
    if not path.exists():
        if str(source).startswith("/") and recording is not None and _is_recording(recording):
            return make_fixes(str(source), read_messages(recording, str(source)))
        raise SegslamError(
            f"{source}: no such file, nor a topic of a recording; give CSV, NMEA, RTKLIB .pos, a KITTI oxts folder, or "
            "the topic of a recording that is mapped"
        )
    if _is_recording(path):
        return make_fixes(path, read_messages(path, ""))
    if path.is_dir():
        if not (path / "timestamps.txt").exists():
            raise SegslamError(f"{path}: no timestamps.txt; give the oxts folder of KITTI's raw data, or a file")
        return make_fixes(path, read_oxts(path))
    lines = text_lines(path)
    if is_nmea(lines):
        rows, note = read_nmea(path, lines)
        return make_fixes(path, rows, note=note)
    return make_fixes(path, read_rtklib(path, lines) if is_rtklib(lines) else read_csv(path, lines))


def _is_recording(path: Path) -> bool:
    """True for a bag or MCAP file, and for a folder of ROS 2 or with bags."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() or any(path.glob("*.bag"))
    return path.suffix.lower() in RECORDINGS
