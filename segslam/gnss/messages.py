"""Fixes from sensor_msgs/NavSatFix messages of ROS bags and MCAP files."""

from pathlib import Path
from typing import Any

from segslam.core.errors import brief
from segslam.core.types import SegslamError
from segslam.gnss.fixes import Row

MESSAGE = "sensor_msgs/msg/NavSatFix"
UNKNOWN = 0
"""`position_covariance_type` of a covariance that is not known."""


def read_messages(recording: Path, topic: str) -> list[Row]:
    """The fixes of a topic; of the only one if it is empty.

    Raises SegslamError, naming the recording and its topics, if there is no such topic, if the recording cannot be
    read, or if a package is missing.
    """
    from segslam.scans.bag_messages import BagMessages
    from segslam.scans.mcap_messages import McapMessages

    read = McapMessages if recording.suffix == ".mcap" else BagMessages
    try:
        messages = read(recording, topic, kind=MESSAGE, option="--gnss")
        return [row_of(messages[number][1]) for number in range(len(messages))]
    except ImportError as error:
        raise SegslamError(f"{recording}: {error}") from error
    except Exception as error:  # the readers raise anything for damaged data
        what = str(error) if isinstance(error, ValueError) else repr(error)
        raise SegslamError(f"{recording}: its messages cannot be read ({brief(what, 300)})") from error


def row_of(message: Any) -> Row:
    """The fix of a message. REP 145: the covariance is that of east, north, up; status -1 is no fix."""
    stamp = message.header.stamp
    nanosec = stamp.nanosec if hasattr(stamp, "nanosec") else stamp.nsec
    sigma_m = (float("nan"), float("nan"), float("nan"))
    if message.position_covariance_type != UNKNOWN:
        east, north, up = (float(value) for value in list(message.position_covariance)[::4])
        sigma_m = _root(east), _root(north), _root(up)
    has_fix = int(message.status.status) >= 0
    place = float(message.latitude), float(message.longitude), float(message.altitude)
    return Row(int(stamp.sec) * 10**9 + int(nanosec), *place, sigma_m, has_fix)


def _root(variance: float) -> float:
    return variance**0.5 if variance > 0.0 else float("nan")
