"""Stamps from texts."""

import pytest

from segslam.core import stamps


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("0", 0),
        ("1.5", 1_500_000_000),
        ("4.574208e+02", 457_420_800_000),
        ("1764000000.123456789", 1764000000123456789),
        ("1764000000123", 1764000000123000000),
        ("1764000000123456", 1764000000123456000),
        ("1764000000123456789", 1764000000123456789),
        ("1.764000000123456789e18", 1764000000123456789),
        ("4000000000", 4_000_000_000_000_000_000),
    ],
)
def test_seconds_become_exact_nanoseconds(text: str, stamp_ns: int) -> None:
    assert stamps.nanoseconds(text) == stamp_ns


@pytest.mark.parametrize("text", ["", "now", "nan", "inf"])
def test_text_that_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a time in seconds"):
        stamps.nanoseconds(text)
