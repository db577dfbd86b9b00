"""Messages on one topic that can only be read one after the other, as those of ROS bags (ROS 1 and ROS 2)."""

import weakref
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, TypeVar

from segslam.core.config import parse_yaml
from segslam.core.extras import how_to_install

CLOUD = "sensor_msgs/msg/PointCloud2"
Message = TypeVar("Message")
MIN_BYTES = 32
"""Fewest bytes of a message with a cloud, compressed or not: its record header and stamp."""


class InOrder(Generic[Message]):
    """The messages of an iterator, which is started again to go back.

    Raises ValueError for a number of clouds that a file of `num_bytes` cannot have; None: of smaller messages.
    """

    def __init__(self, start: Callable[[], Iterator[Message]], num_messages: int, *, num_bytes: int | None) -> None:
        if num_bytes is not None and num_messages > num_bytes // MIN_BYTES:
            raise ValueError(f"its index is damaged: it claims {num_messages} messages in {num_bytes} bytes")
        self._start = start
        self._num_messages = num_messages
        self._messages = start()
        self._next = 0
        self._damage = ""

    def __len__(self) -> int:
        return self._num_messages

    def __getitem__(self, index: int) -> Message:
        """Raises the exception of the iterator, and then ValueError for all messages after it."""
        if index < self._next:
            self._messages, self._next, self._damage = self._start(), 0, ""
        if self._damage:
            raise ValueError(self._damage)
        try:
            while True:
                message = next(self._messages)
                self._next += 1
                if self._next > index:
                    return message
        except StopIteration:
            self._damage = f"the recording ends after {self._next} of {self._num_messages} messages"
            raise ValueError(self._damage) from None
        except Exception as error:  # of a foreign reader, whose iterator has ended with it
            self._damage = f"the recording is damaged after {self._next} messages: {type(error).__name__}"
            raise


class BagMessages:
    """Messages of one kind, read in order. Replaces kiss_icp's reader, which ends the program for a missing topic.

    Raises ValueError if the bag has no such topic, SegslamError if its metadata are damaged, ImportError if the package
    is missing, and what rosbags raises.
    """

    is_sequential = True

    def __init__(self, data: Path, topic: str, *, kind: str = CLOUD, option: str = "--topic") -> None:
        """`option` is that which names the topic, for messages; an empty topic is the only one of this kind."""
        try:
            from rosbags.highlevel import AnyReader
        except ImportError as error:
            raise ImportError(f"reading ROS bags needs a package: {how_to_install('recordings')}") from error
        files = [file for file in sorted(data.glob("*.bag")) if not file.name.startswith(".")] if data.is_dir() else []
        metadata = data / "metadata.yaml"
        if not files and metadata.is_file():
            # rosbags needs seconds before it refuses a damaged text that is nested deeply
            parse_yaml(metadata.read_text(encoding="utf-8"), str(metadata))
        self._bag = AnyReader(files or [data])
        self._bag.open()
        weakref.finalize(self, _close, self._bag)
        counts = {name: info.msgcount for name, info in self._bag.topics.items() if info.msgtype == kind}
        topic = one_topic(counts, topic, kind=kind, option=option)
        self._connections = [connection for connection in self._bag.connections if connection.topic == topic]
        stored = [file for path in files or [data] for file in ([path] if path.is_file() else path.iterdir())]
        num_bytes = sum(file.stat().st_size for file in stored if file.is_file())
        self._raw = InOrder(self._messages, counts[topic], num_bytes=num_bytes if kind == CLOUD else None)

    def __len__(self) -> int:
        return len(self._raw)

    def __getitem__(self, index: int) -> tuple[int, Any]:
        """Log time (ns) and decoded message. Raises what rosbags raises for a damaged one."""
        log_ns, data, kind = self._raw[index]
        return log_ns, self._bag.deserialize(data, kind)

    def _messages(self) -> Iterator[tuple[int, bytes, str]]:
        for connection, log_ns, data in self._bag.messages(connections=self._connections):
            yield log_ns, data, connection.msgtype


def one_topic(known: Collection[str], wanted: str, *, kind: str, option: str) -> str:
    """The wanted topic, or the only one. Raises ValueError with the known ones."""
    found = [name for name in known if name == wanted or not wanted]
    if len(found) != 1:
        topics = ", ".join(f"{option} {name}" for name in sorted(known)) or "none"
        raise ValueError(f"give one topic of type {kind}; the recording has: {topics}")
    return found[0]


def _close(bag: Any) -> None:
    with suppress(Exception):  # of a damaged database; nothing is written
        bag.close()
