"""Content of a scan file: its header, its rows as columns, and the times of its points within the sweep.

All parsers raise ValueError with what is wrong.
"""

import math
import os
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

from segslam.core.errors import brief, unreadable
from segslam.core.types import BadScan, Vector

MAX_SCAN_BYTES = 2**30
"""Largest file that is read as one scan. Chosen: 60 million points of 16 bytes, 200 times the largest known sweep."""
MAX_HEADER_BYTES = 65_536
"""Largest header in which its last line is searched. Chosen: 1,000 comments; usual headers have 300 bytes."""
TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "timestamps", "stamps")
"""Names for the time of a point, in any unit (Ouster, Velodyne, Hesai, Robosense, Livox); the first there is counts."""
INTENSITY_FIELDS = ("intensity", "reflectivity", "signal")
"""Names that drivers and programs use for the intensity; the first that exists is used."""
UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
"""Seconds (driver of Velodyne), microseconds and nanoseconds (Hesai, Livox, Ouster)."""
PERIODS_S = (0.05, 0.1, 0.2)
"""Periods of rotating LiDARs: 20, 10 or 5 Hz."""
LONGEST_SEAM = 0.29
"""Chosen: largest fraction of a period without returns at either end of the sweep; above it 15 Hz passes for 10 Hz."""
LEAST_SHARE = 0.5
"""Chosen: times between 0 and 1 that span this are fractions; no LiDAR turns as slowly as twice per second."""
JITTER = 0.02
"""Chosen: relative tolerance of a period."""
NO_POINTS = "it has no points"
Columns = dict[str, np.ndarray]
"""One array (n,) per field, by its name in the file."""


class Field(NamedTuple):
    """A field of each row: `num_values` values of one type (with byte order)."""

    name: str
    dtype: np.dtype
    num_values: int = 1


def read_bytes(file: Path) -> bytes:
    """The content of a scan file. Raises BadScan if it cannot be read, or has more than MAX_SCAN_BYTES."""
    try:
        # a pipe is opened without waiting for its writer
        with open(file, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as stream:
            status = os.fstat(stream.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise BadScan(f"{file}: not a regular file; give a scan")
            if status.st_size > MAX_SCAN_BYTES:
                raise BadScan(f"{file}: {status.st_size} bytes are too many for one scan (at most {MAX_SCAN_BYTES})")
            return stream.read()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise BadScan(unreadable(file, "scan", error)) from error


def read_header(content: bytes, last: str) -> tuple[list[list[str]], int]:
    """The words of each line up to the line that begins with `last`, and the position of the data after it."""
    lines: list[list[str]] = []
    start = 0
    while (end := content.find(b"\n", start, MAX_HEADER_BYTES)) >= 0:
        words = content[start:end].decode("latin-1").split()
        start = end + 1
        if words:
            lines.append(words)
            if words[0] == last:
                return lines, start
    raise ValueError(f"its header has no line {last}")


def number(text: str) -> int:
    """A count in a header."""
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise ValueError(f"its header has {text[:40]!r} where a number is expected")
    return int(text)


def binary_columns(
    content: bytes | memoryview, start: int, num_rows: int, fields: Sequence[Field], *, is_last: bool
) -> Columns:
    """The fields of rows that follow one another, as views; `is_last`: nothing follows the rows."""
    row = np.dtype([(f"{k}", field.dtype, (field.num_values,)) for k, field in enumerate(fields)])
    check_size(len(content) - start, num_rows * row.itemsize, num_rows, tolerated=row.itemsize - 1 if is_last else None)
    if num_rows == 0:
        raise ValueError(NO_POINTS)
    rows = np.frombuffer(content, row, num_rows, start)
    return by_name((field.name, rows[f"{k}"][:, 0]) for k, field in enumerate(fields) if field.num_values == 1)


def text_columns(content: bytes, start: int, num_rows: int, fields: Sequence[Field], *, is_last: bool) -> Columns:
    """The fields of rows in text, as float32 or float64; `is_last`: nothing follows the rows."""
    if num_rows == 0:
        raise ValueError(NO_POINTS)
    num_columns = sum(field.num_values for field in fields)
    wanted = num_rows * num_columns
    if 2 * wanted - 1 > len(content) - start:
        raise ValueError(
            f"it is truncated: its header claims {wanted} numbers, but {len(content) - start} bytes follow"
        )
    words = content[start:].split(None, wanted)
    if len(words) == wanted and not content[-1:].isspace():
        raise ValueError("its last line has no end, so its last number may be cut; add a line end if it is whole")
    if len(words) < wanted or (is_last and len(words) > wanted):
        raise ValueError(f"it is truncated or damaged: its header claims {wanted} numbers, the file has {len(words)}")
    if content.find(b"_", start) >= 0:
        raise ValueError("its points contain a _, which is no part of a number")  # Python allows it
    try:
        numbers = np.fromiter(map(float, words), np.float64, wanted)
    except ValueError as error:
        raise ValueError(brief(str(error))) from error
    rows = numbers.reshape(num_rows, num_columns)
    ends = np.cumsum([field.num_values for field in fields])
    with np.errstate(over="ignore"):
        return by_name(
            (one.name, rows[:, end - 1].astype(np.float32 if one.dtype.str[1:] == "f4" else np.float64))
            for one, end in zip(fields, ends, strict=True)
            if one.num_values == 1
        )


def check_size(num_bytes: int, expected: int, num_rows: int, *, tolerated: int | None) -> None:
    """Raises ValueError for fewer bytes than expected, or more than the `tolerated` bytes after them (None: any)."""
    if num_bytes < expected or (tolerated is not None and num_bytes > expected + tolerated):
        what = "truncated" if num_bytes < expected else "damaged"
        raise ValueError(
            f"it is {what}: its header claims {num_rows} points, {expected} bytes, but {num_bytes} bytes follow"
        )


def by_name(columns: Iterable[tuple[str, np.ndarray]]) -> Columns:
    """The columns by name. Padding may have a name several times."""
    named: Columns = {}
    for name, values in columns:
        if name in named and name in ("x", "y", "z"):
            raise ValueError(f"its header has the field {name} twice")
        named.setdefault(name, values)
    return named


class Sweep(NamedTuple):
    """When the points of a scan were measured."""

    times: Vector
    """(n,) 0 at the start of the sweep to 1 at its end; empty if unknown."""
    duration_s: float
    """From 0 to 1; 0 if unknown."""
    stamp_time: float
    """That of the stamp; 1 if unknown."""


def sweep_of(times: np.ndarray, num_points: int, stamp_s: float, *, counts_from_stamp: bool) -> Sweep:
    """The sweep of a scan, from the times of its points.

    `times` (n,) may count from the start of the sweep, up to its end (negative), or absolutely with the stamp `stamp_s`
    at its start or end; or they are fractions already. They are divided by the period of the sensor if a usual one
    fits, so that a sweep without returns at its start or end is not stretched; otherwise by their span. Their unit is
    that in which they span a time most like a usual period. There are none if times are missing, not finite, all equal,
    or not one per point. `counts_from_stamp`: times near 0 count from the stamp, as in messages with a header.
    """
    if len(times) != num_points or num_points == 0 or not np.isfinite(times).all():
        return Sweep(np.empty(0), 0.0, 1.0)
    first, last = float(times.min()), float(times.max())
    span = last - first
    if not 0.0 < span < np.inf:
        return Sweep(np.empty(0), 0.0, 1.0)
    if first >= 0.0 and last <= 1.0 and span >= LEAST_SHARE:
        return Sweep(times, 0.0, 1.0)
    unit_s = min(UNITS_S, key=lambda unit_s: abs(math.log(span) - math.log(median(PERIODS_S) / unit_s)))
    start, duration = first, span
    for period in (period_s / unit_s for period_s in PERIODS_S):
        if (1.0 - LONGEST_SEAM) * period <= span <= (1.0 + JITTER) * period:
            for possible in (0.0, -period, stamp_s / unit_s, stamp_s / unit_s - period):
                if possible - JITTER * period <= first and last <= possible + (1.0 + JITTER) * period:
                    start, duration = possible, period
                    break
    is_absolute = min(abs(first), abs(last)) > duration
    stamp = stamp_s / unit_s if is_absolute else 0.0 if counts_from_stamp else math.inf
    stamp_time = (stamp - start) / duration
    if not -JITTER <= stamp_time <= 1.0 + JITTER:
        stamp_time = 1.0
    times = np.clip((times - start) / duration, 0.0, 1.0)
    return Sweep(times, duration * unit_s, min(max(stamp_time, 0.0), 1.0))
