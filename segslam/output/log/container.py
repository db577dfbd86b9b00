"""Reading of MCAP files, complete, truncated (process killed, disk full) or damaged (power failure)."""

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, MessageIndex, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError, frame_content_size

_DAMAGE = (ValueError, struct.error, McapError, ZstdError, RuntimeError, MemoryError, OverflowError)
"""Exceptions on damaged data: a wrong checksum, a short field, data that zstd or lz4 cannot decompress."""
_RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length at the start of each record."""
_FOOTER_BYTES = _RECORD_HEAD.size + 20
_KINDS: dict[Opcode, Any] = {
    Opcode.HEADER: Header,
    Opcode.METADATA: Metadata,
    Opcode.CHUNK: Chunk,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.DATA_END: DataEnd,
}
"""The records of the data section of a log."""
_MOST_CHUNK_BYTES = 2**30
"""Chosen: a step has some megabytes; more than this is a damaged size, or data made to exhaust the memory."""


class CutError(Exception):
    """The file ends or is damaged at this byte."""

    def __init__(self, offset: int) -> None:
        super().__init__(f"byte {offset}")
        self.offset = offset


class Stored(NamedTuple):
    """A message."""

    topic: str
    schema: Schema
    data: bytes
    channel_id: int
    chunk: tuple[int, int]
    """Position in the file, and size, of the chunk that contains the message."""


def messages(path: Path, *, since_last: str | None = None) -> Iterator[Stored]:
    """Each message in the order of the file. Raises CutError at a cut, after the complete messages before it.

    With `since_last`, and if the file has an index, reading starts at the last chunk with a message of this topic.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    start = 0
    with path.open("rb") as stream:
        if since_last is not None and (summary := summary_of(stream)) is not None:
            schemas, channels = dict(summary.schemas), dict(summary.channels)
            ids = {channel.id for channel in channels.values() if channel.topic == since_last}
            holding = (chunk for chunk in summary.chunk_indexes if ids & chunk.message_index_offsets.keys())
            start = max((chunk.chunk_start_offset for chunk in holding), default=0)
        for offset, size, record in _records_of_chunks(stream, start):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None or channel.schema_id not in schemas:
                    raise CutError(offset)
                yield Stored(channel.topic, schemas[channel.schema_id], record.data, channel.id, (offset, size))


def message_within(records: bytes, channel_id: int) -> bytes | None:
    """Data of the first message of a channel in records of a log; None without one before the end, or a damage."""
    with suppress(CutError):
        for _, _, record in _records_of_chunks(BytesIO(MCAP0_MAGIC + records)):
            if isinstance(record, Message) and record.channel_id == channel_id:
                return record.data
    return None


def metadata(path: Path) -> tuple[dict[str, dict[str, str]], CutError | None]:
    """The metadata before the first message, by name, and a cut before it. Raises OSError as `open`."""
    found: dict[str, dict[str, str]] = {}
    with path.open("rb") as stream:
        try:
            for _, _, record in _records(stream):
                if isinstance(record, Chunk):
                    break
                if isinstance(record, Metadata):
                    found[record.name] = record.metadata
        except CutError as cut:
            return found, cut
    return found, None


def count(path: Path, topic: str) -> int:
    """Number of messages of a topic, from the index if there is one, otherwise by reading the file."""
    with path.open("rb") as stream:
        summary = summary_of(stream)
        if summary is not None and summary.statistics is not None:
            counts = summary.statistics.channel_message_counts
            return sum(counts.get(channel.id, 0) for channel in summary.channels.values() if channel.topic == topic)
    number = 0
    with suppress(CutError):
        for message in messages(path):
            number += message.topic == topic
    return number


def summary_of(stream: IO[bytes]) -> Summary | None:
    """The index at the end of a file; None if it is missing or damaged."""
    with suppress(OSError, *_DAMAGE):
        size = stream.seek(0, os.SEEK_END)
        end = size - len(MCAP0_MAGIC)
        stream.seek(end - _FOOTER_BYTES)
        footer = Footer.read(ReadDataStream(BytesIO(stream.read(_FOOTER_BYTES)[_RECORD_HEAD.size :])))
        if len(MCAP0_MAGIC) <= footer.summary_start < end:
            stream.seek(footer.summary_start)
            if zlib.crc32(stream.read(end - footer.summary_start)[:-4]) == footer.summary_crc:  # the index has no other
                stream.seek(0)
                return SeekingReader(stream, record_size_limit=size).get_summary()
    return None


def _records(stream: IO[bytes] | BytesIO, start: int = 0) -> Iterator[tuple[int, int, object]]:
    """Offset, size and content of each record of a file from `start`, up to the end of the data section.

    Raises CutError for an incomplete or damaged record, for a record that a log does not have there, and for a file
    that is not MCAP.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise CutError(0)
    if start > size:
        raise CutError(size)
    offset = max(start, len(MCAP0_MAGIC))
    stream.seek(offset)
    while True:
        head = stream.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise CutError(offset)
        opcode, length = _RECORD_HEAD.unpack(head)
        if length > size - offset:  # cut, or a damaged length, which may not even fit in memory
            raise CutError(offset)
        record = _record(offset, opcode, stream.read(length))
        if isinstance(record, DataEnd):
            return
        yield offset, _RECORD_HEAD.size + length, record
        offset += _RECORD_HEAD.size + length


def _record(offset: int, opcode: int, body: bytes) -> object:
    """A record of the data section. Raises CutError for another one, and if it does not fill its length."""
    stream = BytesIO(body)
    try:
        kind = _KINDS[Opcode(opcode)]  # after a power failure, pages that were not written read as zeros
        record = kind.read(ReadDataStream(stream))
    except (KeyError, *_DAMAGE) as error:
        raise CutError(offset) from error
    if stream.tell() != len(body):  # a damaged length, which contains the records behind
        raise CutError(offset)
    return record


def _records_of_chunks(stream: IO[bytes] | BytesIO, start: int = 0) -> Iterator[tuple[int, int, object]]:
    """Each record in the chunks of a file from `start`, with offset and size of its chunk. Raises as `_records`."""
    for offset, size, chunk in _records(stream, start):
        if not isinstance(chunk, Chunk):
            continue
        try:
            allocated = frame_content_size(chunk.data) if chunk.compression == "zstd" else 0  # as zstd will do
            if max(chunk.uncompressed_size, allocated) > _MOST_CHUNK_BYTES:
                raise CutError(offset)
            records = list(breakup_chunk(chunk, validate_crc=True))
        except _DAMAGE as error:
            raise CutError(offset) from error
        yield from ((offset, size, record) for record in records)
