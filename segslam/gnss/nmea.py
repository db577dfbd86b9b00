"""Fixes from NMEA 0183: GGA (position, height, quality) and RMC (position, date); others only give the date (ZDA)."""

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import MAXYEAR, MINYEAR, UTC, date, datetime, time, timedelta
from functools import reduce
from operator import xor
from pathlib import Path

from segslam.core.errors import counted
from segslam.core.stamps import stamp_of
from segslam.core.types import SegslamError
from segslam.gnss.fixes import NMEA, Row, bad_line, check_degrees, number_in

LEAST_WORDS = {"GGA": 10, "RMC": 10, "ZDA": 5}
"""Sentences that have a time, and up to which field they are read."""


def is_nmea(lines: Sequence[str]) -> bool:
    """True if a line contains a sentence."""
    return any(re.search(NMEA, line) for line in lines)


def read_nmea(file: Path, lines: Sequence[str]) -> tuple[list[Row], str]:
    """The fixes of all talkers, and a note about their heights; GGA where there is any, else RMC.

    Text before the $ is ignored, such as the time of the computer or a binary message. Lines with a wrong checksum are
    left out, and those without one, unless no line has any. Raises SegslamError, naming file and line, if all are
    wrong, or for a position with a right checksum that is none.
    """
    found: dict[str, list[Row]] = {"GGA": [], "RMC": []}
    contents = {number: line.rpartition("$")[2].strip() for number, line in enumerate(lines, 1) if "$" in line}
    is_checked = any("*" in content for content in contents.values())
    all_words = {number: _words(content) if is_checked else content.split(",") for number, content in contents.items()}
    sentences = {number: words for number, words in all_words.items() if words}
    num_wrong = len(all_words) - len(sentences)
    if not sentences:
        raise SegslamError(f"{file}: all {num_wrong} NMEA sentences have wrong checksums; log them again")
    for number, moment in _moments(file, sentences).items():
        kind = sentences[number][0][-3:]
        if kind in found:
            found[kind].append(_row(file, number, kind, sentences[number], moment))
    left_out = f"; {counted(num_wrong, 'line')} with wrong checksums left out" if num_wrong else ""
    left_out += "" if is_checked else "; no line has a checksum"
    if not found["GGA"]:
        return found["RMC"], f"no heights{left_out}"
    heights = "altitude above the geoid and geoid separation, as the receiver gives them, added to ellipsoidal heights"
    return found["GGA"], f"heights: {heights}{left_out}"


def _moments(file: Path, sentences: Mapping[int, Sequence[str]]) -> dict[int, datetime]:
    """The moment of each sentence with a time; without a date, on the day that is nearest to the one before.

    Before the first date, it is the day nearest to the one after; in a file without dates the first day is 1970-01-01.
    """
    timed = [
        (number, _date(words), _time(file, number, words[1]))
        for number, words in sentences.items()
        if len(words) >= LEAST_WORDS.get(words[0][-3:], math.inf) and words[1]
    ]
    first = next((row for row, (_, day, _) in enumerate(timed) if day is not None), 0)
    moments: dict[int, datetime] = {}
    for part in (timed[first::-1], timed[first:]):
        last = datetime(1970, 1, 1, 12, tzinfo=UTC)
        for number, day, at in part:
            moment = datetime.combine(day or last, time(), tzinfo=UTC) + at
            if day is None:
                moment += timedelta(days=round((last - moment) / timedelta(days=1)))
            moments[number] = last = moment
    return moments


def _words(sentence: str) -> list[str] | None:
    """The fields of a sentence after its $; None if its checksum is wrong or missing."""
    content, star, checksum = sentence.rpartition("*")
    total = reduce(xor, content.encode(errors="replace"), 0)
    return content.split(",") if star and checksum.upper() == f"{total:02X}" else None


def _row(file: Path, number: int, kind: str, words: Sequence[str], moment: datetime) -> Row:
    first = 2 if kind == "GGA" else 3
    latitude, longitude = (
        _degrees(file, number, words[place], words[place + 1], digits) for place, digits in ((first, 2), (first + 2, 3))
    )
    check_degrees(file, number, latitude, longitude)
    if kind == "RMC":
        return Row(stamp_of(moment), latitude, longitude, has_fix=words[2] == "A")
    height_m = number_in(file, number, words[9], "altitude")
    if len(words) > 11 and words[11]:
        height_m += number_in(file, number, words[11], "geoid separation")
    return Row(stamp_of(moment), latitude, longitude, height_m, has_fix=words[6] not in ("", "0"))


def _degrees(file: Path, number: int, text: str, hemisphere: str, digits: int) -> float:
    """Degrees of `ddmm.mmm`, with so many digits of degrees; NaN for an empty field."""
    if not text:
        return float("nan")
    degrees = number_in(file, number, text[:digits], "degrees") + number_in(file, number, text[digits:], "minutes") / 60
    return -degrees if hemisphere in ("S", "W") else degrees


def _time(file: Path, number: int, text: str) -> timedelta:
    """The time since midnight; a leap second, 60, is the second after 59."""
    try:
        whole, _, fraction = text.partition(".")
        second = int(whole[4:6])
        at = time(int(whole[:2]), int(whole[2:4]), second - (second == 60), int(fraction.ljust(6, "0")[:6] or 0))
        return datetime.combine(date.min, at) - datetime.min + timedelta(seconds=second == 60)
    except ValueError as error:
        raise bad_line(file, number, f"time {text[:20]} is not hhmmss.ss") from error


def _date(words: Sequence[str]) -> date | None:
    """The date of RMC (ddmmyy) or ZDA; None if there is none."""
    with suppress(ValueError):
        if words[0][-3:] == "RMC" and len(words) > 9:
            year = int(words[9][4:6])
            return date(year + (1900 if year > 79 else 2000), int(words[9][2:4]), int(words[9][:2]))
        if words[0][-3:] == "ZDA" and len(words) > 4 and MINYEAR < int(words[4]) < MAXYEAR:
            return date(int(words[4]), int(words[3]), int(words[2]))
    return None
