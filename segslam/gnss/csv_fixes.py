"""Fixes from a CSV file: time, latitude, longitude, height, standard deviations.

With a header the columns may be in any order and have one of several common names; without one they are in the order
above. Separators are semicolons (then decimal commas are read), commas, tabs or blanks; text after # is ignored, unless
it is a header: the names of as many columns as the first fix has.
"""

import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from segslam.core.errors import brief
from segslam.core.stamps import nanoseconds, stamp_of
from segslam.core.types import SegslamError
from segslam.gnss.fixes import Row, bad_line, check_degrees, number_in

COLUMNS = {
    "time": "header_stamp time t seconds timestamp stamp stamp_s time_s sec secs utc unix_time",
    "time_ns": "time_ns stamp_ns timestamp_ns nanoseconds",
    "fraction_ns": "nanosec nanosecs nsec nsecs",
    "latitude": "latitude latitude_deg lat lat_deg",
    "longitude": "longitude longitude_deg lon lon_deg lng long",
    "height": "height height_m altitude altitude_m alt alt_m h ellipsoidal_height ele",
    "sigma_east": "sigma_east sigma_east_m sd_east sde std_lon sigma_e sigma_x",
    "sigma_north": "sigma_north sigma_north_m sd_north sdn std_lat sigma_n sigma_y",
    "sigma_up": "sigma_up sigma_up_m sd_up sdu std_alt sigma_u sigma_z vertical_accuracy",
    "sigma": "sigma sigma_m accuracy horizontal_accuracy hacc std sd",
    "status": "status status_status",
    "quality": "quality fix valid",
}
"""Names of each column; the first that a file has counts."""
ORDER = ("time", "latitude", "longitude", "height", "sigma_east", "sigma_north", "sigma_up")
"""Columns of a file without header."""
NEEDED = ("latitude", "longitude")
LEAST_STATUS = {"status": 0.0, "quality": 1.0}
"""Least number of a fix: a status as in NavSatFix is -1 for none, a quality as in NMEA 0."""


def read_csv(file: Path, lines: Sequence[str]) -> list[Row]:
    """The fixes of a CSV file. Raises SegslamError, naming file and line, for anything else."""
    content = [(number, line.split("#")[0]) for number, line in enumerate(lines, 1)]
    content = [(number, line) for number, line in content if line.strip()]
    if not content:
        raise SegslamError(f"{file}: contains no line with a fix; give another file")
    number, line = content[0]
    first = _cells(line)
    if any(re.search(r"[A-Za-z]{2}", cell) and cell.lower() not in ("nan", "null") for cell in first[1:]):
        content, places = content[1:], _places(first)
        if missing := _missing(places):
            known = ", ".join(brief(name, 20) for name in first[:12])
            raise bad_line(file, number, f"no column {' or '.join(missing)} among {known}", "name the columns so")
    else:
        if len(first) < 3:
            raise bad_line(file, number, f"{len(first)} columns", "give at least time, latitude, longitude")
        comments = (_cells(line.lstrip("# ")) for line in lines[: number - 1])
        headers = (_places(cells) for cells in comments if len(cells) == len(first))
        positions = {name: place for place, name in enumerate(ORDER) if place < len(first)}
        places = next((named for named in headers if not _missing(named)), positions)
    return [_row(file, number, _cells(line), places) for number, line in content]


def _cells(line: str) -> list[str]:
    for separator in (";", ",", "\t"):
        if separator in line:  # a comma that is left is a decimal one
            return [cell.strip().strip('"').replace(",", ".") for cell in line.split(separator)]
    return line.split()


def _places(names: Sequence[str]) -> dict[str, int]:
    """The place of each known column among the names of a header."""
    cleaned = [
        re.sub(r"[^a-z0-9_]", "", re.sub(r"[\[(].*|^field\.", "", name.lower()).strip().translate({32: "_", 46: "_"}))
        for name in names
    ]
    return {
        column: cleaned.index(alias)
        for column, aliases in COLUMNS.items()
        for alias in reversed(aliases.split())
        if alias in cleaned
    }


def _missing(places: Mapping[str, int]) -> list[str]:
    """The columns without which there is no fix."""
    is_timed = "time" in places or "time_ns" in places
    return [*([] if is_timed else ["time"]), *(name for name in NEEDED if name not in places)]


def _row(file: Path, number: int, cells: Sequence[str], places: dict[str, int]) -> Row:
    needed = max(places[name] for name in (*NEEDED, *[one for one in ("time", "time_ns") if one in places]))
    if len(cells) <= needed:
        raise bad_line(file, number, f"{len(cells)} columns; at least {needed + 1} are needed")

    known = {name: cells[place] for name, place in places.items() if place < len(cells)}

    def value(name: str) -> float:
        return number_in(file, number, known.get(name, ""), name)

    latitude, longitude = value("latitude"), value("longitude")
    check_degrees(file, number, latitude, longitude)
    both = value("sigma")
    east, north, up = (value(f"sigma_{axis}") for axis in ("east", "north", "up"))
    is_ns = "time_ns" in places
    stamp_ns = _stamp(file, number, known["time_ns" if is_ns else "time"], is_ns=is_ns)
    if "fraction_ns" in places and not is_ns:
        stamp_ns += _stamp(file, number, known.get("fraction_ns", ""), is_ns=True)
    return Row(
        stamp_ns,
        latitude,
        longitude,
        value("height"),
        (both if np.isnan(east) else east, both if np.isnan(north) else north, up),
        has_fix=all(_has_fix(known.get(name, ""), least) for name, least in LEAST_STATUS.items()),
    )


def _stamp(file: Path, number: int, text: str, *, is_ns: bool) -> int:
    """Time in ns of a number, in ns or as `nanoseconds` understands it, or of a date in ISO 8601."""
    text = text.strip()
    try:
        if re.match(r"\d{4}-\d\d-\d\d", text):
            text, is_leap = re.subn(r"(\d\d:\d\d):60", r"\1:59", text, count=1)  # the second after 59
            return stamp_of(datetime.fromisoformat(text.replace("Z", "+00:00"))) + is_leap * 10**9
        return int(text) if is_ns else nanoseconds(text)
    except (ValueError, OverflowError) as error:
        what = f"time {brief(text, 40)} is neither a number of seconds nor a date as 2026-01-31T12:00:00Z"
        raise bad_line(file, number, what) from error


def _has_fix(text: str, least: float) -> bool:
    """True unless a status, as number or word, is that of no fix."""
    text = text.strip().lower()
    if text in ("", "true", "yes", "fix", "float", "single", "rtk", "a"):
        return True
    try:
        return float(text) >= least
    except ValueError:
        return re.sub(r"[\s_-]", "", text) not in ("false", "no", "none", "nofix", "v", "invalid")
