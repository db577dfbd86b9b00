"""Position fixes of any source: the kind is found from the content. Messages and KITTI's oxts folder are read here."""

from pathlib import Path
from typing import Any

from segslam.core.errors import brief
from segslam.core.stamps import dated_nanoseconds
from segslam.core.types import SegslamError
from segslam.core.whole_files import expanded
from segslam.gnss.csv_fixes import read_csv
from segslam.gnss.fixes import Fixes, Row, bad_line, check_degrees, make_fixes, number_in, text_lines
from segslam.gnss.nmea import is_nmea, read_nmea
from segslam.gnss.rtklib import is_rtklib, read_rtklib

OXTS_ACCURACY = 23
"""Column of the accuracy of the position (m), counted from 0, as the devkit's dataformat.txt lists them."""


def read_fixes(source: str | Path, *, recording: Path | None = None) -> Fixes:
    """The fixes of a CSV, NMEA or RTKLIB file, an oxts folder, a recording, or a topic of `recording`.

    Raises SegslamError, naming file and line, if they cannot be read.
    """
    path = expanded(source)
    if not path.exists():
        if str(source).startswith("/") and recording is not None and _is_recording(recording):
            return make_fixes(str(source), _read_messages(recording, str(source)))
        raise SegslamError(
            f"{source}: no such file, nor a topic of a recording; give CSV, NMEA, RTKLIB .pos, a KITTI oxts folder, or "
            "the topic of a recording that is mapped"
        )
    if _is_recording(path):
        return make_fixes(path, _read_messages(path, ""))
    if path.is_dir():
        if not (path / "timestamps.txt").exists():
            raise SegslamError(f"{path}: no timestamps.txt; give the oxts folder of KITTI's raw data, or a file")
        return make_fixes(path, _read_oxts(path))
    lines = text_lines(path)
    if is_nmea(lines):
        rows, note = read_nmea(path, lines)
        return make_fixes(path, rows, note=note)
    return make_fixes(path, read_rtklib(path, lines) if is_rtklib(lines) else read_csv(path, lines))


def _is_recording(path: Path) -> bool:
    """True for a bag or MCAP file, and for a folder of ROS 2 or with bags."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() or any(path.glob("*.bag"))
    return path.suffix.lower() in (".bag", ".mcap", ".db3")


def _read_messages(recording: Path, topic: str) -> list[Row]:
    """The fixes of a topic; of the only one if it is empty."""
    from segslam.scans.messages import BagMessages, McapMessages

    read = McapMessages if recording.suffix.lower() == ".mcap" else BagMessages
    try:
        messages = read(recording, topic, kinds=["sensor_msgs/msg/NavSatFix"], option="--gnss")
        return [row_of(messages[number][1]) for number in range(len(messages))]
    except SegslamError:
        raise
    except ImportError as error:
        raise SegslamError(f"{recording}: {error}") from error
    except Exception as error:  # the readers raise anything for damaged data
        what = str(error) if isinstance(error, ValueError) else repr(error)
        raise SegslamError(f"{recording}: its messages cannot be read ({brief(what, 300)})") from error


def row_of(message: Any) -> Row:
    """The fix of a message. REP 145: the covariance is that of east, north, up; status -1 is no fix."""
    stamp = message.header.stamp
    is_known = message.position_covariance_type != 0
    variances = [float(value) if is_known else -1.0 for value in list(message.position_covariance)[::4]]
    east, north, up = (variance**0.5 if variance > 0.0 else float("nan") for variance in variances)
    has_fix = int(message.status.status) >= 0
    place = float(message.latitude), float(message.longitude), float(message.altitude)
    return Row(int(stamp.sec) * 10**9 + int(stamp.nanosec), *place, (east, north, up), has_fix)


def _read_oxts(folder: Path) -> list[Row]:
    """The fixes of a folder with `timestamps.txt` and `data/`. Raises SegslamError, naming the file."""
    times = [line.strip() for line in text_lines(folder / "timestamps.txt") if line.strip()]
    files = sorted(file for file in (folder / "data").glob("*.txt") if not file.name.startswith("."))
    if len(times) != len(files):
        raise SegslamError(
            f"{folder}: {len(times)} lines in timestamps.txt, but {len(files)} files in data; copy it again"
        )
    rows = []
    for number, (file, text) in enumerate(zip(files, times, strict=True), 1):
        try:
            stamp_ns = dated_nanoseconds(text)
        except ValueError as error:
            raise bad_line(folder / "timestamps.txt", number, f"{text[:40]} is no date and time") from error
        words = " ".join(text_lines(file)).split()
        if len(words) < 3:
            raise SegslamError(f"{file}: {len(words)} values; latitude, longitude and altitude are needed")
        latitude, longitude, height_m = (number_in(file, 1, word, "coordinate") for word in words[:3])
        check_degrees(file, 1, latitude, longitude)
        sigma_m = number_in(file, 1, words[OXTS_ACCURACY], "accuracy") if len(words) > OXTS_ACCURACY else float("nan")
        rows.append(Row(stamp_ns, latitude, longitude, height_m, (sigma_m, sigma_m, sigma_m)))
    return rows
