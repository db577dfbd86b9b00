"""Fixes from NMEA 0183: GGA (position, height, quality) and RMC (position, date); others only give the date (ZDA)."""

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime, time, timedelta
from functools import reduce
from itertools import pairwise
from operator import xor
from pathlib import Path

from segslam.core.types import SegslamError
from segslam.gnss.fixes import Row, bad_line, check_degrees, number_in, stamp_of


def is_nmea(lines: Sequence[str]) -> bool:
    """True if one of the first lines is a sentence."""
    return any(re.search(r"\$..(GGA|RMC|GSA|GSV|ZDA)", line) for line in lines[:50])


def read_nmea(file: Path, lines: Sequence[str]) -> tuple[list[Row], str]:
    """The fixes of all talkers, and a note about their heights; GGA where there is any, else RMC.

    Text before the $ is ignored, such as the time of the computer. Lines with a wrong checksum are left out, and those
    without one, unless no line has any. Raises SegslamError, naming file and line, if all are wrong, or for a
    position with a right checksum that is none.
    """
    found: dict[str, list[Row]] = {"GGA": [], "RMC": []}
    contents = {number: line.partition("$")[2].strip() for number, line in enumerate(lines, 1) if "$" in line}
    is_checked = any("*" in content for content in contents.values())
    all_words = {number: _words(content) if is_checked else content.split(",") for number, content in contents.items()}
    sentences = {number: words for number, words in all_words.items() if words}
    num_wrong = len(all_words) - len(sentences)
    if not sentences:
        raise SegslamError(f"{file}: all {num_wrong} NMEA sentences have wrong checksums; log them again")
    # Without RMC or ZDA the times are those of a day.
    day = next(filter(None, map(_date, sentences.values())), date(1970, 1, 1)) - _midnights_before_date(file, sentences)
    last = None
    for number, words in sentences.items():
        kind = words[0][-3:]
        named = _date(words) or day
        if named != day:  # the date has passed midnight already
            day, last = named, None
        if kind not in found or len(words) < 10 or not words[1]:
            continue
        at = _time(file, number, words[1])
        if last is not None and datetime.combine(day, last) - datetime.combine(day, at) > timedelta(hours=12):
            day += timedelta(days=_date(words) is None)  # midnight, before the next date
        last = at
        found[kind].append(_row(file, number, kind, words, datetime.combine(day, at, tzinfo=UTC)))
    left_out = f"; {num_wrong} lines with wrong checksums left out" if num_wrong else ""
    left_out += "" if is_checked else "; no line has a checksum"
    if not found["GGA"]:
        return found["RMC"], f"no heights{left_out}"
    heights = "altitude above the geoid and geoid separation, as the receiver gives them, added to ellipsoidal heights"
    return found["GGA"], f"heights: {heights}{left_out}"


def _midnights_before_date(file: Path, sentences: Mapping[int, Sequence[str]]) -> timedelta:
    """Days between the first sentence with a time and the first one with a date."""
    times = []
    for number, words in sentences.items():
        if words[0][-3:] in ("GGA", "RMC", "ZDA") and len(words) > 1 and words[1]:
            times.append(datetime.combine(date.min, _time(file, number, words[1])))
        if _date(words) is not None:
            return timedelta(days=sum(a - b > timedelta(hours=12) for a, b in pairwise(times)))
    return timedelta()


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


def _time(file: Path, number: int, text: str) -> time:
    try:
        whole, _, fraction = text.partition(".")
        return time(int(whole[:2]), int(whole[2:4]), int(whole[4:6]), int(fraction.ljust(6, "0")[:6] or 0))
    except ValueError as error:
        raise bad_line(file, number, f"time {text[:20]} is not hhmmss.ss") from error


def _date(words: Sequence[str]) -> date | None:
    """The date of RMC (ddmmyy) or ZDA; None if there is none."""
    try:
        if words[0][-3:] == "RMC" and len(words) > 9:
            year = int(words[9][4:6])
            return date(year + (1900 if year > 79 else 2000), int(words[9][2:4]), int(words[9][:2]))
        if words[0][-3:] == "ZDA" and len(words) > 4:
            return date(int(words[4]), int(words[3]), int(words[2]))
    except ValueError:
        return None
    return None
