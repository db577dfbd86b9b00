"""Lines, numbers and times in text files of fixes, and errors that name the line."""

import math
from bisect import bisect_right
from datetime import UTC, datetime, timedelta
from pathlib import Path

from segslam.core.errors import brief, unreadable
from segslam.core.types import SegslamError

MOST_BYTES = 2**30
"""Chosen: no log of fixes is larger than a gigabyte."""
GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
LEAPS = [
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
    *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
    *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
]
"""Days (UTC) that begin after a leap second since GPS began (IERS Bulletin C)."""
_LEAP_TIMES = [datetime.fromisoformat(day).replace(tzinfo=UTC) for day in LEAPS]


def text_lines(file: Path) -> list[str]:
    """The lines of a file. Raises SegslamError if it cannot be read as text."""
    try:
        if file.stat().st_size > MOST_BYTES:
            raise SegslamError(f"{file}: larger than 1 GB; is it a file of position fixes?")
        content = file.read_bytes()
    except OSError as error:
        raise SegslamError(f"{unreadable(file, 'fixes', error)}; give another file with --gnss") from error
    if b"\0" in content[:4096]:
        raise SegslamError(f"{file}: a binary file; give CSV, NMEA or RTKLIB .pos, a KITTI oxts folder, or a recording")
    return content.decode("utf-8", errors="replace").lstrip("\ufeff").splitlines()


def bad_line(file: Path, number: int, what: str, remedy: str = "correct or remove the line") -> SegslamError:
    """An error for a line, counted from 1."""
    return SegslamError(f"{file}:{number}: {what}; {remedy}")


def number_in(file: Path, line: int, text: str, name: str) -> float:
    """The number in a cell. Raises SegslamError if it is none; an empty cell, `nan`, `null` and infinity are NaN."""
    text = text.strip()
    if text.lower() in ("", "nan", "null", "none", "na"):
        return float("nan")
    try:
        value = float(text)
        return value if math.isfinite(value) else float("nan")
    except ValueError as error:
        raise bad_line(file, line, f"{name} {brief(text, 30)} is not a number") from error


def check_degrees(file: Path, line: int, latitude_deg: float, longitude_deg: float) -> None:
    """Raises SegslamError for a latitude beyond 90 or a longitude beyond 360 degrees; NaN is allowed."""
    if abs(latitude_deg) > 90.0:
        hint = "is it a longitude, or metres?" if abs(latitude_deg) <= 360.0 else "degrees are needed, not metres"
        raise bad_line(file, line, f"latitude {latitude_deg:g} is not within -90 and 90 degrees", hint)
    if abs(longitude_deg) > 360.0:
        raise bad_line(file, line, f"longitude {longitude_deg:g} is not within -180 and 180 degrees")


def stamp_of(moment: datetime) -> int:
    """Nanoseconds since 1970 of a moment; one without a time zone is in UTC."""
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    since = aware - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def utc_of_gps(moment: datetime) -> datetime:
    """The moment in UTC of one in GPS time, which has no leap seconds: 18 s earlier since 2017."""
    leaps = bisect_right(_LEAP_TIMES, moment)
    utc = moment - timedelta(seconds=leaps)
    return utc if bisect_right(_LEAP_TIMES, utc) == leaps else utc + timedelta(seconds=1)


def stamp_of_week(week: int, seconds: float) -> int:
    """Nanoseconds since 1970, UTC, of a GPS week and second of the week."""
    whole = int(seconds)
    moment = GPS_EPOCH + timedelta(weeks=week, seconds=whole)
    return stamp_of(utc_of_gps(moment)) + round((seconds - whole) * 1e9)
