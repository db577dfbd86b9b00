"""Lines, numbers and times in text files of fixes, and errors that name the line."""

import math
from bisect import bisect_right
from datetime import UTC, datetime, timedelta
from pathlib import Path

from segslam.core.errors import brief, unreadable
from segslam.core.types import SegslamError

MOST_BYTES = 2**30
"""Chosen: no log of fixes is larger than a gigabyte."""
LEAPS = [
    datetime(year, month, 1, tzinfo=UTC)
    for year, month in (
        *((1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7)),
        *((1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1)),
    )
]
"""Days (UTC) that begin after a leap second since GPS began (IERS Bulletin C)."""


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
    leaps = bisect_right(LEAPS, moment)
    utc = moment - timedelta(seconds=leaps)
    return utc if bisect_right(LEAPS, utc) == leaps else utc + timedelta(seconds=1)
