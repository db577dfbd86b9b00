"""Messages on one topic of a recording: of ROS bags (1 and 2), read in order; of MCAP files, found by their index."""

import heapq
import struct
import weakref
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import IO, Any, Generic, NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, MessageIndex
from mcap.records import Message as McapMessage
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary

from segslam.core.config import parse_yaml
from segslam.core.errors import SegslamError, counted
from segslam.core.extras import how_to_install
from segslam.scans.decoding import CLOUDS, decoder
from segslam.scans.scan_files import MAX_SCAN_BYTES

Message = TypeVar("Message")
MIN_BYTES = 32
"""Fewest bytes of a message with a cloud, compressed or not: its record header and stamp."""
DAMAGE = (McapError, ValueError, OverflowError, struct.error)
"""Exceptions of the library for damaged records."""
MAGIC = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file."""
DAMAGED_INDEX = "the index of the file is damaged"


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
            self._damage = f"the recording is damaged after {counted(self._next, 'message')}: {type(error).__name__}"
            raise


class BagMessages:
    """Messages of some kinds, read in order. Replaces kiss_icp's reader, which ends the program for a missing topic.

    Raises SegslamError if the bag has no such topic or its metadata are damaged, ImportError if the package is missing,
    and what rosbags raises.
    """

    is_sequential = True

    def __init__(self, data: Path, topic: str, *, kinds: Sequence[str] = CLOUDS, option: str = "--topic") -> None:
        """`option` is that which names the topic, for messages; an empty topic is the only one of these kinds."""
        try:
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
        except ImportError as error:
            raise ImportError(f"reading ROS bags needs a package: {how_to_install('recordings')}") from error
        files = [file for file in sorted(data.glob("*.bag")) if not file.name.startswith(".")] if data.is_dir() else []
        metadata = data / "metadata.yaml"
        if not files and metadata.is_file():
            # rosbags needs seconds before it refuses a damaged text that is nested deeply
            parse_yaml(metadata.read_text(encoding="utf-8"), str(metadata))
        is_ros1 = bool(files) or data.suffix == ".bag"
        open_reader = Reader1 if is_ros1 else Reader2
        connections = {}
        for file in files or [data]:
            reader = open_reader(file)
            reader.open()
            weakref.finalize(self, _close, reader)
            connections[reader] = [one for one in reader.connections if one.msgtype in kinds]
        topics = {one.topic for known in connections.values() for one in known}
        topic = one_topic(data, topics, topic, kinds=kinds, option=option)
        self._connections = {
            reader: [one for one in known if one.topic == topic] for reader, known in connections.items()
        }
        found = [one for known in self._connections.values() for one in known]
        self._decode = {one.msgtype: decoder(one.msgtype, is_ros1=is_ros1) for one in found}
        stored = [file for path in files or [data] for file in ([path] if path.is_file() else path.iterdir())]
        num_bytes = sum(file.stat().st_size for file in stored if file.is_file()) if kinds == CLOUDS else None
        self._raw = InOrder(self._messages, sum(one.msgcount for one in found), num_bytes=num_bytes)

    def __len__(self) -> int:
        return len(self._raw)

    def __getitem__(self, index: int) -> tuple[int, Any]:
        """Log time (ns) and decoded message. Raises what rosbags raises for a damaged one."""
        log_ns, data, kind = self._raw[index]
        return log_ns, self._decode[kind](data)

    def _messages(self) -> Iterator[tuple[int, bytes, str]]:
        # of no connections, rosbags gives all messages
        streams = [
            reader.messages(connections=_as_stored(reader, known))
            for reader, known in self._connections.items()
            if known
        ]
        for connection, log_ns, data in heapq.merge(*streams, key=itemgetter(1)):
            yield log_ns, data, connection.msgtype


class _Place(NamedTuple):
    """Position of a message: its time, the position of its chunk in the file, and its own in the chunk's data."""

    log_ns: int
    chunk: int
    offset: int


class McapMessages:
    """Messages of some kinds, by their order in time, of ROS 1 or 2. Replaces kiss_icp's reader, which needs ROS 2.

    A message in a damaged chunk cannot be read; the others can. In a file without chunks, or without an index of their
    messages, none after the damage can. Raises ValueError if the file has no index, SegslamError if it is no MCAP file
    or has no such topic, ImportError if rosbags is missing.
    """

    def __init__(self, file: Path, topic: str, *, kinds: Sequence[str] = CLOUDS, option: str = "--topic") -> None:
        """As `BagMessages`."""
        self._file = file
        self._chunk: tuple[int, bytes] = (-1, b"")
        with file.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise SegslamError(f"{file}: cannot be opened as MCAP, it is empty or of another kind; copy it again")
            stream.seek(0)
            summary = _summary(stream)
            assert summary.statistics is not None
            known = [one for one in summary.channels.values() if one.schema_id]
            if not summary.channels or any(one.schema_id not in summary.schemas for one in known):
                raise ValueError("its index lacks channels or schemas; `mcap recover` adds them")
            names = {kind.replace("/msg/", "/"): kind for kind in kinds} | {kind: kind for kind in kinds}  # ROS 1, 2
            alike = [one for one in known if summary.schemas[one.schema_id].name in names]
            self._topic = one_topic(file, {one.topic for one in alike}, topic, kinds=kinds, option=option)
            channels = {one.id: one for one in alike if one.topic == self._topic}
            counts = summary.statistics.channel_message_counts
            self._num_messages = sum(counts.get(id, 0) for id in channels)
            self._places = _places(stream, summary, channels)
        self._decode: dict[int, Callable[[bytes], Any]] = {}
        for id, one in channels.items():
            if one.message_encoding not in ("cdr", "ros1"):
                raise SegslamError(
                    f"{file}: messages on {one.topic} are encoded as {one.message_encoding}, not as those of ROS 1 "
                    "(ros1) or ROS 2 (cdr); give the bag from which it was converted"
                )
            kind = names[summary.schemas[one.schema_id].name]
            self._decode[id] = decoder(kind, is_ros1=one.message_encoding == "ros1")
        self._in_order = None
        if len(self._places) != self._num_messages:
            num_bytes = file.stat().st_size if kinds == CLOUDS else None
            self._in_order = InOrder(self._messages, self._num_messages, num_bytes=num_bytes)
        self.is_sequential = self._in_order is not None

    def __len__(self) -> int:
        return self._num_messages

    def __getitem__(self, index: int) -> tuple[int, Any]:
        """Log time (ns) and decoded message. Raises what the decoders raise for a damaged one."""
        message = self._found(self._places[index]) if self._in_order is None else self._in_order[index]
        return message.log_time, self._decode[message.channel_id](message.data)

    def _found(self, place: _Place) -> McapMessage:
        if self._chunk[0] != place.chunk:
            with self._file.open("rb") as stream:
                self._chunk = (place.chunk, _chunk_data(stream, place.chunk))
        data = BytesIO(self._chunk[1])
        data.seek(place.offset)
        record = ReadDataStream(data)
        if record.read1() == Opcode.MESSAGE:
            message = McapMessage.read(record, record.read8())
            if message.channel_id in self._decode and message.log_time == place.log_ns:
                return message
        raise ValueError(DAMAGED_INDEX)

    def _messages(self) -> Iterator[McapMessage]:
        with self._file.open("rb") as stream:
            for _, _, message in make_reader(stream, validate_crcs=True).iter_messages(topics=[self._topic]):
                if message.channel_id in self._decode:
                    yield message


def one_topic(recording: Path, known: Collection[str], wanted: str, *, kinds: Sequence[str], option: str) -> str:
    """The wanted topic, or the only one. Raises SegslamError with the known ones."""
    found = [name for name in known if name == wanted or not wanted]
    if len(found) != 1:
        topics = ", ".join(f"{option} {name}" for name in sorted(known)) or "none"
        asked = f"no topic {wanted}" if wanted else "give one topic"
        raise SegslamError(f"{recording}: {asked} of type {' or '.join(kinds)}; the recording has: {topics}")
    return found[0]


def _as_stored(reader: Any, connections: list[Any]) -> list[Any]:
    """The connections of a folder of ROS 2 as its files describe them, by topic and type.

    rosbags gives no messages of a connection whose quality of service in metadata.yaml is not that in the file, though
    programs change one of the two.
    """
    stored = [
        one for storage in getattr(getattr(reader, "storage", None), "storages", ()) for one in storage.connections
    ]
    described = [
        one._replace(ext=other.ext, digest="")
        for one in connections
        for other in stored
        if (one.topic, one.msgtype) == (other.topic, other.msgtype)
    ]
    return described or connections


def _close(bag: Any) -> None:
    with suppress(Exception):  # of a damaged database; nothing is written
        bag.close()


def _summary(stream: IO[bytes]) -> Summary:
    summary = None
    with suppress(*DAMAGE):
        summary = make_reader(stream).get_summary()
    if summary is None or summary.statistics is None:
        raise ValueError("the file has no index, for example after a crash; `mcap recover` adds one")
    return summary


def _places(stream: IO[bytes], summary: Summary, channels: dict[int, Channel]) -> list[_Place]:
    """The place of each message on these channels, in order of time; not those of damaged parts of the index."""
    places: list[_Place] = []
    for chunk in summary.chunk_indexes:
        for channel in channels.keys() & chunk.message_index_offsets.keys():
            with suppress(*DAMAGE):
                stream.seek(chunk.message_index_offsets[channel] + 9)  # opcode and length of the record
                index = MessageIndex.read(ReadDataStream(stream))
                entries = index.records if index.channel_id == channel else []
                places += [_Place(log_ns, chunk.chunk_start_offset, offset) for log_ns, offset in entries]
    return sorted(places)


def _chunk_data(stream: IO[bytes], start: int) -> bytes:
    """The decompressed messages of a chunk. Raises ValueError if their checksum is wrong or there are too many."""
    stream.seek(start)
    record = ReadDataStream(stream)
    if record.read1() == Opcode.CHUNK and record.read8() <= MAX_SCAN_BYTES:
        chunk = Chunk.read(record)
        if chunk.uncompressed_size <= MAX_SCAN_BYTES:
            data, num_bytes = get_chunk_data_stream(chunk, validate_crc=True)
            return data.read(num_bytes)
    raise ValueError("the chunk of this message is damaged")
