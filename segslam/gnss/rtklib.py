"""Fixes from RTKLIB's .pos files: geodetic or ECEF, GPS time or UTC, with weeks or dates."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from segslam.core.stamps import stamp_of
from segslam.gnss.fixes import Row, bad_line, check_degrees, number_in
from segslam.gnss.geodesy import Origin, geodetic_from_ecef, rotation_ecef_enu

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
LEAPS = [
    datetime(year, month, 1, tzinfo=UTC)
    for year, month in (
        *((1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7)),
        *((1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1)),
    )
]
"""Days (UTC) that begin after a leap second since GPS began (IERS Bulletin C)."""
AHEAD_OF_UTC = {"UTC": timedelta(0), "JST": timedelta(hours=9)}
"""Clocks of a header without leap seconds between them; the other is that of GPS."""


def is_rtklib(lines: Sequence[str]) -> bool:
    """True if the header names the columns of a solution."""
    return any(line.startswith("%") and ("latitude(" in line or "x-ecef" in line) for line in lines[:100])


def read_rtklib(file: Path, lines: Sequence[str]) -> list[Row]:
    """The fixes of a solution. Raises SegslamError, naming file and line, for a line that is none."""
    rows, is_ecef, is_in_parts, clock = [], False, False, "GPST"
    for number, line in enumerate(lines, 1):
        if line.startswith("%"):
            if "latitude(" in line or "x-ecef" in line:
                is_ecef, is_in_parts = "x-ecef" in line, "(d'" in line
                clock = next((name for name in AHEAD_OF_UTC if name in line.lstrip("% ").split()[:1]), "GPST")
            continue
        words = line.replace(",", " ").split()
        if not words:
            continue
        if is_in_parts and len(words) >= 8:
            words[2:8] = (_degrees(file, number, words[first : first + 3]) for first in (2, 5))
        if len(words) < 7:
            raise bad_line(file, number, f"{len(words)} columns; time, position and quality are needed")
        rows.append(_row(file, number, words, is_ecef=is_ecef, clock=clock))
    return rows


def _degrees(file: Path, number: int, parts: Sequence[str]) -> str:
    """Degrees, minutes and seconds as degrees; the sign of the first is that of all."""
    whole, minutes, seconds = (number_in(file, number, word, "coordinate") for word in parts)
    return repr(math.copysign(abs(whole) + minutes / 60.0 + seconds / 3600.0, whole))


def _row(file: Path, number: int, words: Sequence[str], *, is_ecef: bool, clock: str) -> Row:
    position = np.array([number_in(file, number, word, "coordinate") for word in words[2:5]])
    errors = np.full(3, np.nan)
    if len(words) >= 10:
        errors = np.array([number_in(file, number, word, "standard deviation") for word in words[7:10]])
    sigma_m = errors[[1, 0, 2]]  # north comes before east
    if is_ecef:
        position = geodetic_from_ecef(position[None])[0] if np.isfinite(position).all() else np.full(3, np.nan)
        rotation = rotation_ecef_enu(Origin(*position.tolist()))
        sigma_m = np.sqrt((rotation.T**2) @ errors**2)  # without the correlations of the axes of ECEF
    latitude, longitude, height_m = position.tolist()
    check_degrees(file, number, latitude, longitude)
    stamp_ns = _stamp(file, number, words[0], words[1], clock=clock)
    return Row(stamp_ns, latitude, longitude, height_m, tuple(sigma_m.tolist()), words[5] != "0")


def _stamp(file: Path, number: int, first: str, second: str, *, clock: str) -> int:
    """Time (ns) of a week since GPS began and a second of the week, or of a date and time."""
    try:
        if "/" not in first:
            week, seconds = int(first), float(second)
            moment = GPS_EPOCH + timedelta(weeks=week, seconds=int(seconds))
            return stamp_of(_utc(moment, clock)) + round((seconds - int(seconds)) * 1e9)
        whole, _, fraction = second.partition(".")
        is_leap = whole.endswith(":60")  # the second after 59
        whole = whole.removesuffix(":60") + ":59" * is_leap
        moment = datetime.strptime(f"{first} {whole}", "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC)
        moment += timedelta(seconds=is_leap)
        return stamp_of(_utc(moment, clock)) + int(fraction.ljust(9, "0")[:9])
    except (ValueError, OverflowError) as error:
        what = f"time {first[:20]} {second[:20]} is neither week and seconds nor a date"
        raise bad_line(file, number, what) from error


def _utc(moment: datetime, clock: str) -> datetime:
    """The moment in UTC of one by the clock of a header; GPS time has no leap seconds: UTC is 18 s less since 2017."""
    if clock in AHEAD_OF_UTC:
        return moment - AHEAD_OF_UTC[clock]
    leaps = bisect_right(LEAPS, moment)
    utc = moment - timedelta(seconds=leaps)
    return utc if bisect_right(LEAPS, utc) == leaps else utc + timedelta(seconds=1)
