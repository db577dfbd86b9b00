"""Geodetic positions in a finished log: channels for Foxglove's Map panel, added behind the result.

Readers of earlier versions ignore the channels. While they are added the log has no index, as after a power failure,
and is readable all the same.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import DataEnd, Footer, McapRecord, Statistics
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from segslam.core.interrupts import interrupts_wait
from segslam.core.types import Indices, Points, SegslamError, Vector
from segslam.output.log.container import summary_of
from segslam.output.log.foxglove import timestamp


@dataclass(frozen=True, slots=True, eq=False)
class Locations:
    """The messages of a channel."""

    frame: str
    stamp_ns: Indices
    """(n,) times (ns), ascending."""
    places: Points
    """(n, 3) latitude and longitude (degrees), height above the ellipsoid (m); NaN for a height that is unknown."""
    sigma_m: Vector
    """(3,) standard deviations: east, north, up; not finite if unknown."""


def write_locations(log: Path, locations: Mapping[str, Locations]) -> None:
    """Add channels with positions to a finished log, by topic; they replace those of an earlier call.

    Raises SegslamError if the log has no index, OSError if it cannot be written.
    """
    with log.open("r+b") as stream:
        summary = summary_of(stream)
        if summary is None or summary.statistics is None:
            raise SegslamError(f"{log}: has no index; `segslam replay` it into a new folder first")
        replaced = {channel.id for channel in summary.channels.values() if channel.topic in locations}
        kept = [chunk for chunk in summary.chunk_indexes if not replaced & chunk.message_index_offsets.keys()]
        # chunks of an earlier call are the last ones
        end = max(chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length for chunk in kept)
        added, made = _records(summary, locations, offset=end)
        chunks = [*kept, *made.chunk_indexes]
        assert made.statistics is not None
        statistics = _joined(summary.statistics, made.statistics, replaced)
        statistics.chunk_count = len(chunks)
        records = [*made.schemas.values(), *made.channels.values(), statistics, *chunks, *summary.metadata_indexes]
        with interrupts_wait():
            stream.seek(end)
            stream.truncate()
            stream.write(added + _ending(records, offset=end + len(added)))


def _joined(log: Statistics, added: Statistics, replaced: set[int]) -> Statistics:
    """The statistics of a log with added chunks, without the messages of the channels that are replaced."""
    counts = Counter({number: n for number, n in log.channel_message_counts.items() if number not in replaced})
    counts.update(added.channel_message_counts)
    return replace(
        log,
        schema_count=added.schema_count,
        channel_count=added.channel_count,
        channel_message_counts=dict(counts),
        message_count=counts.total(),
        message_start_time=min(log.message_start_time, added.message_start_time),
        message_end_time=max(log.message_end_time, added.message_end_time),
    )


def _records(summary: Summary, locations: Mapping[str, Locations], *, offset: int) -> tuple[bytes, Summary]:
    """The chunks with the messages for a place in the file, and their index, with all channels of the log."""
    stream = BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start()
    for number in sorted(summary.schemas):
        known = summary.schemas[number]
        writer.register_schema(known.name, known.encoding, known.data)
    for number in sorted(summary.channels):
        channel = summary.channels[number]
        writer.register_channel(channel.topic, channel.message_encoding, channel.schema_id)
    ids = {channel.topic: channel.id for channel in summary.channels.values()}
    if missing := [topic for topic in locations if topic not in ids]:
        description = build_file_descriptor_set(LocationFix).SerializeToString()
        schema_id = writer.register_schema(LocationFix.DESCRIPTOR.full_name, "protobuf", description)
        ids |= {topic: writer.register_channel(topic, "protobuf", schema_id) for topic in missing}
    for topic, positions in locations.items():
        for stamp_ns, place in zip(positions.stamp_ns.tolist(), positions.places.tolist(), strict=True):
            message = _message(positions, stamp_ns, place)
            writer.add_message(ids[topic], stamp_ns, message.SerializeToString(), stamp_ns)
    writer.finish()
    made = SeekingReader(BytesIO(stream.getvalue())).get_summary()
    assert made is not None
    first, last = made.chunk_indexes[0], made.chunk_indexes[-1]
    begin, end = first.chunk_start_offset, last.chunk_start_offset + last.chunk_length + last.message_index_length
    for chunk in made.chunk_indexes:
        chunk.chunk_start_offset += offset - begin
        places = {number: place + offset - begin for number, place in chunk.message_index_offsets.items()}
        chunk.message_index_offsets = places
    return stream.getvalue()[begin:end], made


def _ending(records: Iterable[McapRecord], *, offset: int) -> bytes:
    """The end of the data and the index, for a place in the file."""
    builder = RecordBuilder()
    DataEnd(0).write(builder)
    data_end = builder.end()
    for record in records:
        record.write(builder)
    index, start = builder.end(), offset + len(data_end)
    checksum = zlib.crc32(index + struct.pack("<BQQQ", Opcode.FOOTER, 20, start, 0))
    Footer(summary_start=start, summary_offset_start=0, summary_crc=checksum).write(builder)
    return data_end + index + builder.end() + MCAP0_MAGIC


def _message(positions: Locations, stamp_ns: int, place: list[float]) -> LocationFix:
    latitude, longitude, height_m = place
    variance = np.square(positions.sigma_m)
    known = bool(np.isfinite(variance).all())
    return LocationFix(
        timestamp=timestamp(stamp_ns),
        frame_id=positions.frame,
        latitude=latitude,
        longitude=longitude,
        altitude=height_m if np.isfinite(height_m) else 0.0,
        position_covariance=np.diag(variance).ravel().tolist() if known else [0.0] * 9,
        position_covariance_type=LocationFix.DIAGONAL_KNOWN if known else LocationFix.UNKNOWN,
    )
