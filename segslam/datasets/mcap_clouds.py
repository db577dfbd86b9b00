"""ROS 2 point clouds of an MCAP file, read in order."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader

from segslam.system.extras import how_to_install

MESSAGE = "sensor_msgs/msg/PointCloud2"


class McapClouds:
    """Reader of the clouds on one topic; replaces kiss_icp's reader, which fails with mcap-ros2-support 0.6.

    Raises ValueError if the file has no index or no such topic, ImportError if the decoding package is missing.
    """

    read_point_cloud: Callable[[Any], Any]
    """Converts a message to points and times; must be set."""

    def __init__(self, file: Path, topic: str) -> None:
        try:
            from mcap_ros2.decoder import DecoderFactory
        except ImportError as error:
            raise ImportError(f"reading ROS 2 messages needs a package: {how_to_install('recordings')}") from error
        self._file = file
        self._decoders = DecoderFactory()
        self._topic, self._num_clouds = _topic_and_count(file, topic)
        self.reset()

    def __len__(self) -> int:
        return self._num_clouds

    def __getitem__(self, index: int) -> Any:
        """The next cloud, whatever the index."""
        schema, channel, message = next(self._messages)
        self._seconds = message.log_time / 1e9
        decode = self._decoders.decoder_for(channel.message_encoding, schema)
        if decode is None:
            raise ValueError(f"messages on {self._topic} are encoded as {channel.message_encoding}, not as ROS 2's cdr")
        return self.read_point_cloud(decode(message.data))

    def reset(self) -> None:
        """Restart at the first message."""
        self._messages = self._read()

    def get_frames_timestamps(self) -> list[float]:
        """Log time of the last cloud, in seconds."""
        return [self._seconds]

    def _read(self) -> Iterator[tuple[Any, Any, Any]]:
        with self._file.open("rb") as stream:
            yield from make_reader(stream).iter_messages(topics=[self._topic])


def _topic_and_count(file: Path, wanted: str) -> tuple[str, int]:
    summary = None
    with file.open("rb") as stream, suppress(McapError):
        summary = make_reader(stream).get_summary()
    if summary is None or summary.statistics is None:
        raise ValueError("the file has no index, for example after a crash; `mcap recover` adds one")
    counts = {
        channel.topic: summary.statistics.channel_message_counts.get(channel.id, 0)
        for channel in summary.channels.values()
        if channel.schema_id and summary.schemas[channel.schema_id].name == MESSAGE
    }
    found = [topic for topic in counts if topic == wanted or not wanted]
    if len(found) != 1:
        known = ", ".join(f"--topic {topic}" for topic in sorted(counts)) or "none"
        raise ValueError(f"give one topic of type {MESSAGE}; the file has: {known}")
    return found[0], counts[found[0]]
