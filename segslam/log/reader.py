"""An MCAP log back into the steps that made it, up to the cut where it was cut."""

import json
import logging
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, TypeVar

from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from segslam.config import Config, config_from_yaml
from segslam.log import schema
from segslam.log.cloud import KeyframePoints, points_and_labels
from segslam.log.foxglove import transforms
from segslam.log.records import from_json
from segslam.types import GraphEstimate, Keyframe, SegslamError, Step, Trajectory

logger = logging.getLogger(__name__)

_DAMAGE = (ValueError, struct.error, McapError, ZstdError, RuntimeError)
"""What reading a damaged chunk raises: a wrong checksum, a short field, data that zstd or lz4 cannot decompress."""
_RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length, before each record."""


Parts = Mapping[str, bytes]
"""Topic -> the latest message of a step so far."""
Decoded = TypeVar("Decoded")


class _CutError(Exception):
    """The file ends, or makes no sense, from this byte on."""

    def __init__(self, offset: int) -> None:
        super().__init__(f"byte {offset}")
        self.offset = offset


@dataclass(frozen=True, slots=True)
class RunLog:
    """A log that was opened: how its run was made, and access to its steps."""

    path: Path
    config: Config
    """The effective settings of the run."""
    run: Mapping[str, str]
    """schema_version, dataset, sequence, python, platform."""
    packages: Mapping[str, str]
    """Package -> version."""

    def steps(self) -> Iterator[Step]:
        """The steps in the order in which they were made, read as they are asked for.

        A cut or damaged log gives its complete steps up to there, and a warning that says how many.
        Raises SegslamError where the file does not hold what this version writes.
        """
        num_steps = 0
        parts: dict[str, bytes] = {}
        try:
            for topic, data in self._messages():
                if topic != schema.STEP:
                    parts[topic] = data
                    continue
                yield self._decoded(_step, parts, data)
                num_steps, parts = num_steps + 1, {}
        except _CutError as cut:
            size = self.path.stat().st_size
            logger.warning(
                "%s: cut or damaged at byte %d of %d: kept the %d steps before", self.path, cut.offset, size, num_steps
            )

    def result(self) -> tuple[GraphEstimate, Trajectory] | None:
        """The last estimate and the trajectory of every scan; None if the run did not get there."""
        parts: dict[str, bytes] = {}
        try:
            for topic, data in self._messages():
                if topic == schema.RESULT:
                    return self._decoded(_result, parts, data)
                parts[topic] = data
        except _CutError:
            return None
        return None

    def _messages(self) -> Iterator[tuple[str, bytes]]:
        """Topic and data of each message, in the order of the file. Raises _CutError at a cut."""
        topics: dict[int, str] = {}
        with self.path.open("rb") as stream:
            for offset, opcode, body in _records(stream):
                if opcode != Opcode.CHUNK:
                    continue
                try:
                    records = breakup_chunk(Chunk.read(ReadDataStream(BytesIO(body))), validate_crc=True)
                except _DAMAGE as error:
                    raise _CutError(offset) from error
                for record in records:
                    if isinstance(record, Schema):
                        self._check_schema(record)
                    elif isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, Message):
                        yield topics[record.channel_id], record.data

    def _check_schema(self, found: Schema) -> None:
        """Raises SegslamError if the records in the file are not those of this version."""
        for values in schema.json_schemas().values():
            if found.name == values["title"] and found.data != schema.schema_text(values):
                raise SegslamError(
                    f"{self.path}: its {found.name} is not what this version reads; "
                    f"use segslam {self.packages.get('segslam', 'of its time')}, which wrote it"
                )

    def _decoded(self, decode: Callable[[Parts, bytes], Decoded], parts: Parts, data: bytes) -> Decoded:
        try:
            return decode(parts, data)
        except (KeyError, ValueError, TypeError, DecodeError) as error:
            raise SegslamError(f"{self.path}: not as segslam writes it ({error!r}); map the data again") from error


def read_log(path: Path) -> RunLog:
    """Open the log of a run, finished or cut. Raises SegslamError if there is none, or of another schema version."""
    try:
        with path.open("rb") as stream:
            metadata = _metadata(stream)
    except OSError as error:
        raise SegslamError(f"{path}: cannot read the log ({error.strerror}); give the log.mcap of a run") from error
    except _CutError as cut:
        raise SegslamError(f"{path}: no log of segslam, or cut in its first bytes; give the log.mcap of a run") from cut
    run = metadata.get(schema.RUN_METADATA, {})
    if schema.CONFIG_METADATA not in metadata or "schema_version" not in run:
        raise SegslamError(f"{path}: an MCAP file, but no log of segslam; give the log.mcap of a run")
    packages = metadata.get(schema.PACKAGES_METADATA, {})
    if run["schema_version"] != str(schema.VERSION):
        raise SegslamError(
            f"{path}: a log of schema version {run['schema_version']}, this version reads {schema.VERSION}; "
            f"use segslam {packages.get('segslam', 'of its time')}, which wrote it"
        )
    config = config_from_yaml(metadata[schema.CONFIG_METADATA]["yaml"], f"{path} (settings)")
    return RunLog(path=path, config=config, run=run, packages=packages)


def _metadata(stream: IO[bytes]) -> dict[str, dict[str, str]]:
    """The metadata before the first chunk, by name. Raises _CutError."""
    found: dict[str, dict[str, str]] = {}
    for _, opcode, body in _records(stream):
        if opcode == Opcode.CHUNK:
            break
        if opcode == Opcode.METADATA:
            record = Metadata.read(ReadDataStream(BytesIO(body)))
            found[record.name] = record.metadata
    return found


def _records(stream: IO[bytes]) -> Iterator[tuple[int, int, bytes]]:
    """Offset, opcode and body of each record from the start of a file to the end of its data.

    Raises _CutError for a record that is not whole, and for a file that is not MCAP.
    """
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise _CutError(0)
    while True:
        offset, head = stream.tell(), stream.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise _CutError(offset)
        opcode, length = _RECORD_HEAD.unpack(head)
        body = stream.read(length) if opcode in set(Opcode) else b""
        if opcode == 0 or len(body) < length:
            raise _CutError(offset)
        if opcode == Opcode.DATA_END:
            return
        yield offset, opcode, body


def _step(parts: Parts, data: bytes) -> Step:
    keyframe: dict = {}
    if schema.KEYFRAME in parts:
        points, labels = points_and_labels(KeyframePoints.FromString(parts[schema.KEYFRAME]))
        keyframe = {"points": points, "labels": labels}
    estimate = _estimate(parts) if schema.ESTIMATE in parts else None
    return from_json(Step, json.loads(data), {Step: {"estimate": estimate}, Keyframe: keyframe})


def _result(parts: Parts, data: bytes) -> tuple[GraphEstimate, Trajectory]:
    return _estimate(parts), from_json(Trajectory, json.loads(data), {})


def _estimate(parts: Parts) -> GraphEstimate:
    """From the /estimate message and the /trajectory before it."""
    values = json.loads(parts[schema.ESTIMATE])
    poses = transforms(PosesInFrame.FromString(parts[schema.TRAJECTORY]))
    T_world_keyframe = dict(zip(values["keyframe_ids"], poses, strict=True))
    return from_json(GraphEstimate, values, {GraphEstimate: {"T_world_keyframe": T_world_keyframe}})
