"""Fixes from the oxts folder of KITTI's raw data: timestamps.txt, and a file of 30 values for each."""

from datetime import datetime
from pathlib import Path

from segslam.core.types import SegslamError
from segslam.gnss.fixes import Row
from segslam.gnss.text import bad_line, check_degrees, number_in, stamp_of, text_lines

ACCURACY = 23
"""Column of the accuracy of the position (m), counted from 0, as the devkit's dataformat.txt lists them."""


def read_oxts(folder: Path) -> list[Row]:
    """The fixes of a folder with `timestamps.txt` and `data/`. Raises SegslamError, naming the file."""
    times = [line.strip() for line in text_lines(folder / "timestamps.txt") if line.strip()]
    files = sorted(file for file in (folder / "data").glob("*.txt") if not file.name.startswith("."))
    if len(times) != len(files):
        raise SegslamError(
            f"{folder}: {len(times)} lines in timestamps.txt, but {len(files)} files in data; copy it again"
        )
    return [
        _row(file, _stamp(folder, number, text))
        for number, (file, text) in enumerate(zip(files, times, strict=True), 1)
    ]


def _row(file: Path, stamp_ns: int) -> Row:
    words = " ".join(text_lines(file)).split()
    if len(words) < 3:
        raise SegslamError(f"{file}: {len(words)} values; latitude, longitude and altitude are needed")
    latitude, longitude, height_m = (number_in(file, 1, word, "coordinate") for word in words[:3])
    check_degrees(file, 1, latitude, longitude)
    sigma_m = number_in(file, 1, words[ACCURACY], "accuracy") if len(words) > ACCURACY else float("nan")
    return Row(stamp_ns, latitude, longitude, height_m, (sigma_m, sigma_m, sigma_m))


def _stamp(folder: Path, number: int, text: str) -> int:
    """Nanoseconds of a date with up to nine decimals."""
    try:
        whole, _, fraction = text.partition(".")
        return stamp_of(datetime.fromisoformat(whole)) + int(fraction.ljust(9, "0")[:9] or 0)
    except ValueError as error:
        raise bad_line(folder / "timestamps.txt", number, f"{text[:40]} is no date and time") from error
