"""Stamps in the names of scan files, as recorders and data sets write them."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from segslam.core.types import Indices

STAMP = r"(?P<s>[1-9]\d{8,9})[._-](?P<fraction>\d{1,9})|(?P<whole>[1-9]\d{12}(?:\d{3}){0,2})"
NAME = re.compile(STAMP)
PREFIXED_NAME = re.compile(rf"(?P<prefix>|.*\D)(?:{STAMP})")
"""A name that may begin otherwise, as `cloud_1583836591_182590976` of Newer College."""


def stamp_of_name(stem: str) -> int | None:
    """The stamp in a file name: seconds with a fraction, or 19 digits of ns, 16 of us or 13 of ms; or None."""
    found = NAME.fullmatch(stem)
    return None if found is None else _stamp_ns(found, num_digits=0)


def stamps_of_names(files: Sequence[Path]) -> Indices | None:
    """The stamps (ns) in the names of all files; None if one has none, two are equal, or names begin differently.

    None also for a stamp that int64 cannot hold, later than the year 2262.
    Nanoseconds after seconds may lack their zeros: fractions of nine digits in one name show that they are such.
    """
    found = [PREFIXED_NAME.fullmatch(file.stem.removesuffix(".pcd")) for file in files]  # nuScenes: NAME.pcd.bin
    names = [name for name in found if name is not None]
    if not names or len(names) < len(files) or len({name["prefix"] for name in names}) > 1:
        return None
    num_digits = max(len(name["fraction"] or "") for name in names)
    stamps = [_stamp_ns(name, num_digits=num_digits) for name in names]
    return np.array(stamps, dtype=np.int64) if len(set(stamps)) == len(stamps) and max(stamps) < 2**63 else None


def _stamp_ns(name: re.Match[str], *, num_digits: int) -> int:
    """`num_digits`: those of the longest fraction, nine of nanoseconds."""
    if whole := name["whole"]:
        return int(whole.ljust(19, "0"))
    fraction = name["fraction"].zfill(9) if num_digits == 9 else name["fraction"].ljust(9, "0")
    return int(name["s"]) * 1_000_000_000 + int(fraction)
