"""Times of receivers: calendar dates, weeks of GPS, leap seconds."""

from bisect import bisect_right
from datetime import UTC, datetime, timedelta

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
SECONDS_PER_WEEK = 604_800
LEAPS = [
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
    *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
    *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
]
"""Days (UTC) that begin after a leap second since GPS began (IERS Bulletin C)."""
_LEAP_TIMES = [datetime.fromisoformat(day).replace(tzinfo=UTC) for day in LEAPS]


def stamp_of(moment: datetime) -> int:
    """Nanoseconds since 1970 of a moment; one without a time zone is in UTC."""
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    since = aware - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def utc_of_gps(moment: datetime) -> datetime:
    """The moment in UTC of one in GPS time, which has no leap seconds: 18 s earlier since 2017."""
    leaps = bisect_right(_LEAP_TIMES, moment)
    utc = moment - timedelta(seconds=leaps)
    return utc if bisect_right(_LEAP_TIMES, utc) == leaps else utc + timedelta(seconds=1)


def stamp_of_week(week: int, seconds: float) -> int:
    """Nanoseconds since 1970, UTC, of a GPS week and second of the week."""
    whole = int(seconds)
    moment = GPS_EPOCH + timedelta(weeks=week, seconds=whole)
    return stamp_of(utc_of_gps(moment)) + round((seconds - whole) * 1e9)
