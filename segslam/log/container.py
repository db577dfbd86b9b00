"""Reading of MCAP files, complete, truncated (process killed, disk full) or damaged (power failure)."""

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

_DAMAGE = (ValueError, struct.error, McapError, ZstdError, RuntimeError)
"""Exceptions on damaged data: a wrong checksum, a short field, data that zstd or lz4 cannot decompress."""
_RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length at the start of each record."""


class CutError(Exception):
    """The file ends or is damaged at this byte."""

    def __init__(self, offset: int) -> None:
        super().__init__(f"byte {offset}")
        self.offset = offset


class Span(NamedTuple):
    """A range of bytes in a file."""

    offset: int
    size: int


class Stored(NamedTuple):
    """A message."""

    topic: str
    schema: Schema
    data: bytes
    channel_id: int
    chunk: "Span"
    """Position of the chunk that contains the message."""


def messages(path: Path, *, since_last: str | None = None) -> Iterator[Stored]:
    """Each message in the order of the file. Raises CutError at a cut, after the complete messages before it.

    With `since_last`, and if the file has an index, reading starts at the last chunk with a message of this topic.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    start = 0
    with path.open("rb") as stream:
        if since_last is not None and (summary := _summary(stream)) is not None:
            schemas, channels = dict(summary.schemas), dict(summary.channels)
            start = _last_chunk_with(since_last, summary)
        for offset, opcode, body in _records(stream, start):
            span = Span(offset, _RECORD_HEAD.size + len(body))
            for record in _records_of_chunk(offset, body) if opcode == Opcode.CHUNK else ():
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    yield Stored(channel.topic, schemas[channel.schema_id], record.data, channel.id, span)


def messages_within(records: bytes) -> Iterator[tuple[int, bytes]]:
    """Channel and data of each message in a sequence of complete records. Raises CutError if they are damaged."""
    offset = 0
    while offset < len(records):
        opcode, length = _RECORD_HEAD.unpack_from(records, offset)
        body = records[offset + _RECORD_HEAD.size :][:length]
        for record in _records_of_chunk(offset, body) if opcode == Opcode.CHUNK else ():
            if isinstance(record, Message):
                yield record.channel_id, record.data
        offset += _RECORD_HEAD.size + length


def metadata(path: Path) -> dict[str, dict[str, str]]:
    """The metadata before the first message, by name. Raises CutError, or OSError if the file cannot be opened."""
    found: dict[str, dict[str, str]] = {}
    with path.open("rb") as stream:
        for _, opcode, body in _records(stream):
            if opcode == Opcode.CHUNK:
                break
            if opcode == Opcode.METADATA:
                record = Metadata.read(ReadDataStream(BytesIO(body)))
                found[record.name] = record.metadata
    return found


def count(path: Path, topic: str) -> int:
    """Number of messages of a topic, from the index if there is one, otherwise by reading the file."""
    with path.open("rb") as stream:
        summary = _summary(stream)
        if summary is not None and summary.statistics is not None:
            counts = summary.statistics.channel_message_counts
            return sum(counts.get(channel.id, 0) for channel in summary.channels.values() if channel.topic == topic)
    number = 0
    with suppress(CutError):
        for message in messages(path):
            number += message.topic == topic
    return number


def _summary(stream: IO[bytes]) -> Summary | None:
    """The index at the end of a file; None if it is missing or damaged."""
    with suppress(*_DAMAGE):
        return make_reader(stream).get_summary()
    return None


def _last_chunk_with(topic: str, summary: Summary) -> int:
    """Offset of the last chunk with a message of a topic; 0 if there is none."""
    ids = {channel.id for channel in summary.channels.values() if channel.topic == topic}
    holding = (chunk for chunk in summary.chunk_indexes if ids & chunk.message_index_offsets.keys())
    return max((chunk.chunk_start_offset for chunk in holding), default=0)


def _records(stream: IO[bytes], start: int = 0) -> Iterator[tuple[int, int, bytes]]:
    """Offset, opcode and body of each record of a file, starting at `start`, up to the end of the data section.

    Raises CutError for an incomplete record, and for a file that is not MCAP.
    """
    stream.seek(0)
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise CutError(0)
    stream.seek(max(start, len(MCAP0_MAGIC)))
    while True:
        offset, head = stream.tell(), stream.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise CutError(offset)
        opcode, length = _RECORD_HEAD.unpack(head)
        if opcode not in set(Opcode):  # after a power failure, pages that were not written read as zeros
            raise CutError(offset)
        if length > os.fstat(stream.fileno()).st_size:  # a damaged length may not even fit in memory
            raise CutError(offset)
        body = stream.read(length)
        if len(body) < length:
            raise CutError(offset)
        if opcode == Opcode.DATA_END:
            return
        yield offset, opcode, body


def _records_of_chunk(offset: int, body: bytes) -> list[object]:
    try:
        return list(breakup_chunk(Chunk.read(ReadDataStream(BytesIO(body))), validate_crc=True))
    except _DAMAGE as error:
        raise CutError(offset) from error
