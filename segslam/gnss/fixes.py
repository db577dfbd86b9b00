"""Position fixes of a receiver: what their readers return and share, and the checks that need no trajectory."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segslam.core.errors import brief, unreadable
from segslam.core.types import Indices, Mask, Points, SegslamError
from segslam.gnss.geodesy import Geodetic

NO_FIX, NOT_FINITE, DUPLICATE, OUTSIDE = "no_fix", "not_finite", "duplicate", "outside_run"
"""Reasons for which a fix is not used, whatever the trajectory is."""
NMEA = r"\$..(GGA|RMC|GSA|GSV|ZDA),"
"""Begin of a sentence, which a receiver may send between binary messages (u-blox)."""
MOST_BYTES = 2**30
"""Chosen: no log of fixes is larger than a gigabyte."""


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Position fixes in the order of time, a row for each.

    `sigma_m` (n, 3) are the standard deviations to the east, north and up (m) that the receiver claims; NaN if unknown.
    """

    source: str
    """Name of the file or topic, for messages."""
    stamp_ns: Indices
    """(n,) times (ns) in the clock of the receiver, with UTC as epoch where the format has a date."""
    places: Geodetic
    """(n, 3) latitude and longitude (degrees), height above the ellipsoid (m); NaN for a height that is unknown."""
    sigma_m: Points
    reasons: tuple[str, ...]
    """(n,) empty for a usable fix, else the reason for which the reader found it unusable."""
    note: str = ""
    """Remark of the reader for the user, for example about the geoid."""

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def usable(self) -> Mask:
        """(n,) True for fixes without a reason against them."""
        return np.array([not reason for reason in self.reasons], dtype=bool)


@dataclass(frozen=True, slots=True)
class Row:
    """One fix as a reader finds it."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    height_m: float = np.nan
    sigma_m: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    has_fix: bool = True


def make_fixes(source: Path | str, rows: Sequence[Row], *, note: str = "") -> Fixes:
    """The fixes of the rows of a file, sorted by time, each with the reason why it cannot be used, if there is one.

    A fix with the time or the position of the one before is a duplicate: some receivers repeat the last one while
    they have none. Raises SegslamError if there is no usable fix, with the number of each reason.
    """
    if not rows:
        raise SegslamError(f"{source}: contains no position fix; give another file or topic")
    ordered = sorted(rows, key=lambda row: row.stamp_ns)
    if max(abs(ordered[0].stamp_ns), abs(ordered[-1].stamp_ns)) >= 2**63:
        raise SegslamError(f"{source}: a time is more than 292 years from 1970; correct or remove the line")
    places = np.array([(row.latitude_deg, row.longitude_deg, row.height_m) for row in ordered], dtype=np.float64)
    places[~np.isfinite(places)] = np.nan
    sigma_m = np.array([row.sigma_m for row in ordered], dtype=np.float64)
    sigma_m = np.where(np.isfinite(sigma_m) & (sigma_m > 0.0), sigma_m, np.nan)
    stamp_ns = np.array([row.stamp_ns for row in ordered], dtype=np.int64)
    reasons: list[str] = []
    last: tuple[int, list[float]] | None = None
    for row, place in zip(ordered, np.nan_to_num(places, nan=np.inf).tolist(), strict=True):  # NaN equals nothing
        is_default = row.latitude_deg == row.longitude_deg == 0.0  # off the coast of Africa: that of many receivers
        if not row.has_fix or is_default:
            reasons.append(NO_FIX)
        elif not (np.isfinite(row.latitude_deg) and np.isfinite(row.longitude_deg)):
            reasons.append(NOT_FINITE)
        elif last is not None and (row.stamp_ns == last[0] or place == last[1]):
            reasons.append(DUPLICATE)
        else:
            reasons.append("")
            last = row.stamp_ns, place
    fixes = Fixes(str(source), stamp_ns, places, sigma_m, tuple(reasons), note)
    if not fixes.usable.any():
        counts = ", ".join(f"{reasons.count(one)} {one}" for one in sorted(set(reasons)))
        raise SegslamError(
            f"{source}: none of its {len(rows)} fixes can be used ({counts}); give another file or topic"
        )
    return fixes


def text_lines(file: Path) -> list[str]:
    """The lines of a file. Raises SegslamError if it cannot be read as text."""
    try:
        if file.stat().st_size > MOST_BYTES:
            raise SegslamError(f"{file}: larger than 1 GB; is it a file of position fixes?")
        content = file.read_bytes()
    except OSError as error:
        raise SegslamError(f"{unreadable(file, 'fixes', error)}; give another file with --gnss") from error
    if b"\0" in content[:4096] and not re.search(NMEA.encode(), content):
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
