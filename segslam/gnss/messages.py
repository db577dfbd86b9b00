"""Fixes from sensor_msgs/NavSatFix messages of ROS bags and MCAP files."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from segslam.core.errors import brief
from segslam.core.extras import how_to_install
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
    try:
        return [row_of(message) for message in _messages(recording, topic)]
    except SegslamError:
        raise
    except Exception as error:  # the readers raise anything for damaged data
        raise SegslamError(f"{recording}: its messages cannot be read ({brief(repr(error), 120)})") from error


def _messages(recording: Path, topic: str) -> Iterator[Any]:
    if recording.suffix == ".mcap":
        try:
            from mcap_ros2.decoder import DecoderFactory
        except ImportError as error:
            raise _missing(recording) from error
        from mcap.reader import make_reader

        with recording.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            summary = reader.get_summary()
            schemas = {} if summary is None else summary.schemas
            channels = [] if summary is None else summary.channels.values()
            of_fixes = {number for number, schema in schemas.items() if schema.name == MESSAGE}
            chosen = _chosen(recording, topic, [one.topic for one in channels if one.schema_id in of_fixes])
            for *_, message in reader.iter_decoded_messages(topics=[chosen]):
                yield message
        return
    try:
        from rosbags.highlevel import AnyReader
    except ImportError as error:
        raise _missing(recording) from error
    files = sorted(recording.glob("*.bag")) if recording.is_dir() else []
    with AnyReader(files or [recording]) as bag:
        known = [name for name, about in bag.topics.items() if about.msgtype == MESSAGE]
        chosen = _chosen(recording, topic, known)
        connections = [one for one in bag.connections if one.topic == chosen]
        for connection, _, data in bag.messages(connections=connections):
            yield bag.deserialize(data, connection.msgtype)


def _chosen(recording: Path, topic: str, known: list[str]) -> str:
    found = [name for name in dict.fromkeys(known) if name == topic or not topic]
    if len(found) != 1:
        topics = ", ".join(f"--gnss {name}" for name in sorted(set(known))) or "none"
        raise SegslamError(f"{recording}: give one topic of type {MESSAGE}; the recording has: {topics}")
    return found[0]


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


def _missing(recording: Path) -> SegslamError:
    return SegslamError(f"{recording}: reading messages needs a package: {how_to_install('recordings')}")
