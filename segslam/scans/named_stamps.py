"""Stamps in the names of scan files, as recorders and data sets write them."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from segslam.core.types import Indices

STAMP = r"(?P<s>[1-9]\d{8,9})[._-](?P<fraction>\d{1,9})|(?P<ns>[1-9]\d{18})|(?P<us>[1-9]\d{15})"
NAME = re.compile(STAMP)
PREFIXED_NAME = re.compile(rf"(?P<prefix>|.*\D)(?:{STAMP})")
"""A name that may begin otherwise, as `cloud_1583836591_182590976` of Newer College."""


def stamp_of_name(stem: str) -> int | None:
    """The stamp in a file name: seconds with a fraction, or 19 digits of ns or 16 of us since 1970; or None."""
    found = NAME.fullmatch(stem)
    return None if found is None else _stamp_ns(found, num_digits=0)


def stamps_of_names(files: Sequence[Path]) -> Indices | None:
    """The stamps (ns) in the names of all files; None if one has none, two are equal, or names begin differently.

    Nanoseconds after seconds may lack their zeros: fractions of nine digits in one name show that they are such.
    """
    found = [PREFIXED_NAME.fullmatch(file.stem) for file in files]
    names = [name for name in found if name is not None]
    if not names or len(names) < len(files) or len({name["prefix"] for name in names}) > 1:
        return None
    num_digits = max(len(name["fraction"] or "") for name in names)
    stamps = np.array([_stamp_ns(name, num_digits=num_digits) for name in names], dtype=np.int64)
    return stamps if len(np.unique(stamps)) == len(stamps) else None


def _stamp_ns(name: re.Match[str], *, num_digits: int) -> int:
    """`num_digits`: those of the longest fraction, nine of nanoseconds."""
    if name["ns"]:
        return int(name["ns"])
    if name["us"]:
        return 1000 * int(name["us"])
    fraction = name["fraction"].zfill(9) if num_digits == 9 else name["fraction"].ljust(9, "0")
    return int(name["s"]) * 1_000_000_000 + int(fraction)
