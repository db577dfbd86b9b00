"""Stamps, in nanoseconds since 1970 or any other start, from texts and dates."""

from datetime import UTC, datetime, timedelta
from decimal import Decimal

from segslam.core.errors import brief

DECIMALS = (9, 6, 3, 0)
"""Those between nanoseconds and seconds, ms, us and ns."""
EARLIEST_S, LATEST_S = 1_000_000_000, 4_000_000_000
"""Years 2001 and 2096: a larger number that is between them in ms, us or ns is taken for such a time."""


def nanoseconds(seconds: str) -> int:
    """The stamp (ns) of a text, exactly; a double cannot represent it. Raises ValueError if it is not a time.

    A number that is too large for seconds may be a time from 2001 to 2096 in ms, us or ns.
    """
    try:
        time = Decimal(seconds)
        fitting = (num for num in DECIMALS if EARLIEST_S <= time.scaleb(num - 9) < LATEST_S)
        stamp_ns = int(time.scaleb(next(fitting, DECIMALS[0])).to_integral_value())
    except (ArithmeticError, ValueError) as error:
        raise ValueError(f"{brief(seconds)} is not a time in seconds") from error
    if abs(stamp_ns) >= 2**63:
        raise ValueError(f"{brief(seconds)} s are more than 292 years")
    return stamp_ns


def dated_nanoseconds(text: str) -> int:
    """The stamp (ns) of a date and time in UTC, `2011-09-30 12:40:25.072360123`. Raises ValueError for another text."""
    whole, _, fraction = text.partition(".")
    return stamp_of(datetime.fromisoformat(whole)) + int(fraction.ljust(9, "0")[:9])


def stamp_of(moment: datetime) -> int:
    """The stamp (ns) of a moment; one without a time zone is in UTC."""
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return (aware - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
