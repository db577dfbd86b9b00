"""Lossless conversion of records to JSON with a JSON Schema, and back; compact messages for the points of keyframes.

docs/files.md describes both formats. Each record becomes an object with one key per field: `segslam.core.types` defines
them. Large fields are in separate binary messages and omitted from the JSON: see `BULK`.
"""

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.message import Message
from jaxtyping import AbstractArray

from segslam.core.types import GraphEstimate, Keyframe, Labels, Points, Step, Vector

Json = dict[str, Any]
Bulk = Mapping[type, Mapping[str, Any]]
"""Values of the fields that the JSON omits, by record."""

BULK: Mapping[type, frozenset[str]] = {
    Step: frozenset({"estimate"}),
    Keyframe: frozenset({"points", "labels", "intensities", "place"}),
    GraphEstimate: frozenset({"T_world_keyframe"}),
}
"""Fields that the JSON omits."""

_NUMBERS_AND_TEXTS = {bool: "boolean", int: "integer", float: "number", str: "string"}


@dataclass(frozen=True, slots=True)
class Codec:
    """Encoder, decoder and schema of one type."""

    encode: Callable[[Any], Any]
    """Converts a value to objects that `json` can write."""
    decode: Callable[[Any, Bulk], Any]
    """Converts objects that `json` read to a value. Raises ValueError, TypeError or KeyError for invalid data."""
    schema: Json
    """JSON Schema of the encoded values."""


@cache
def codec(hint: Any) -> Codec:
    """The codec of a type: a record, or the type of one of its fields."""
    origin, arguments = get_origin(hint), get_args(hint)
    if is_dataclass(hint):
        return _record(hint)
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return _array(hint)
    if origin is UnionType:
        return _one_of(arguments)
    if origin is tuple:
        item = codec(arguments[0])
        return Codec(
            lambda values: [item.encode(value) for value in values],
            lambda values, bulk: tuple(item.decode(value, bulk) for value in values),
            {"type": "array", "items": item.schema},
        )
    if origin is dict:
        return _mapping(*map(codec, arguments), has_names=get_origin(arguments[0]) is not tuple)
    if issubclass(hint, Enum):
        values = {"type": "string", "enum": [member.value for member in hint]}
        return Codec(lambda member: member.value, lambda value, _: hint(value), values)
    return Codec(hint, lambda value, _: hint(value), {"type": _NUMBERS_AND_TEXTS[hint]})


def _record(record: Any) -> Codec:
    hints = get_type_hints(record)
    kept = [field for field in fields(record) if field.name not in BULK.get(record, ())]
    names = [field.name for field in kept]
    optional = {name for name in names if NoneType in get_args(hints[name])}
    has_default = {field.name for field in kept if not (field.default is field.default_factory is MISSING)}
    absent = dict.fromkeys(optional - has_default)
    required = [name for name in names if name not in optional | has_default]
    codecs = {name: codec(hints[name]) for name in names}

    def encode(value: Any) -> Json:
        present = ((name, getattr(value, name)) for name in names)
        return {name: codecs[name].encode(item) for name, item in present if item is not None}

    def decode(value: Json, bulk: Bulk) -> Any:
        known = {name: codecs[name].decode(value[name], bulk) for name in names if name in value or name in required}
        return record(**absent | known, **(bulk[record] if record in BULK else {}))

    schema = {
        "title": record.__name__,
        "type": "object",
        "properties": {name: codecs[name].schema for name in names},
        "required": required,
    }
    return Codec(encode, decode, schema)


def _array(hint: Any) -> Codec:
    """Codec of an array with the shape in the type hint; at most one dimension is variable."""
    sizes = hint.dim_str.split()
    shape = [int(size) if size.isdigit() else -1 for size in sizes]
    dtype, kind = (np.float64, "number") if "float64" in hint.dtypes else (np.int64, "integer")
    return Codec(
        lambda array: array.ravel().tolist(),
        lambda numbers, _: np.array(numbers, dtype).reshape(shape),
        {"type": "array", "items": {"type": kind}, "description": f"shape {' x '.join(sizes)}, row by row"},
    )


def _one_of(hints: tuple[Any, ...]) -> Codec:
    """Codec of a record or None, which is omitted; or of one of several records."""
    records = {hint.__name__: codec(hint) for hint in hints if hint is not NoneType}
    if len(records) == 1:
        return next(iter(records.values()))

    def encode(value: Any) -> Json:
        name = type(value).__name__
        return {name: records[name].encode(value)}

    def decode(value: Json, bulk: Bulk) -> Any:
        [(name, item)] = value.items()
        return records[name].decode(item, bulk)

    properties = {name: record.schema for name, record in records.items()}
    return Codec(encode, decode, {"type": "object", "properties": properties})


def _mapping(key: Codec, value: Codec, *, has_names: bool) -> Codec:
    if has_names:
        return Codec(
            lambda items: {name: value.encode(item) for name, item in items.items()},
            lambda items, bulk: {name: value.decode(item, bulk) for name, item in items.items()},
            {"type": "object", "properties": {}, "additionalProperties": value.schema},
        )
    properties = {"key": key.schema, "value": value.schema}
    return Codec(
        lambda items: [{"key": key.encode(k), "value": value.encode(v)} for k, v in items.items()],
        lambda rows, bulk: {key.decode(row["key"], bulk): value.decode(row["value"], bulk) for row in rows},
        {"type": "array", "items": {"type": "object", "properties": properties}},
    )


def _message_class() -> type[Message]:
    """Built at run time: seven fields do not justify a compiler and its version."""
    kinds = {
        "resolution_m": FieldDescriptorProto.TYPE_DOUBLE,
        "num_points": FieldDescriptorProto.TYPE_UINT32,
        "folded_difference_planes": FieldDescriptorProto.TYPE_BYTES,
        "labels": FieldDescriptorProto.TYPE_BYTES,
        "intensity_greatest": FieldDescriptorProto.TYPE_DOUBLE,
        "intensity_roots": FieldDescriptorProto.TYPE_BYTES,
        "place": FieldDescriptorProto.TYPE_BYTES,
    }
    file = FileDescriptorProto(name="segslam/keyframe_points.proto", package="segslam", syntax="proto3")
    message = file.message_type.add(name="KeyframePoints")
    for number, (name, kind) in enumerate(kinds.items(), start=1):
        message.field.add(name=name, number=number, type=kind, label=FieldDescriptorProto.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("segslam.KeyframePoints"))


KeyframePoints = _message_class()
"""All points of a keyframe, about 3 bytes per point: segslam.KeyframePoints (protobuf)."""


def keyframe_points(keyframe: Keyframe, *, resolution_m: float) -> Message:
    """The message of a keyframe; coordinates are rounded to multiples of `resolution_m`."""
    points = keyframe.points
    steps = np.ascontiguousarray(np.rint(points.T.astype(np.float64) / resolution_m), dtype=np.int32)
    differences = np.diff(steps, axis=1, prepend=np.int32(0))
    folded = ((differences << 1) ^ (differences >> 31)).astype("<u4", order="C")
    return KeyframePoints(
        resolution_m=resolution_m,
        num_points=len(points),
        folded_difference_planes=folded.view(np.uint8).reshape(3, -1, 4).transpose(0, 2, 1).tobytes(),
        labels=keyframe.labels.tobytes(),
        **({} if keyframe.intensities is None else _roots(keyframe.intensities)),
        **({} if keyframe.place is None else {"place": keyframe.place}),
    )


def points_and_labels(message: Message) -> tuple[Points, Labels]:
    """Points (float32) and labels as written. Raises ValueError for an inconsistent message."""
    planes = np.frombuffer(message.folded_difference_planes, np.uint8).reshape(3, 4, message.num_points)
    folded = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<u4")[..., 0]
    differences = (folded >> 1).astype(np.int32) ^ -(folded & 1).astype(np.int32)
    points = (np.cumsum(differences, axis=1, dtype=np.int32).T * message.resolution_m).astype(np.float32)
    return points, np.frombuffer(message.labels, np.uint8).copy()


def intensities(message: Message) -> Vector | None:
    """Intensity of each point (float32), to one byte; None if intensities were not kept."""
    if not message.intensity_roots:
        return None
    shares = (np.frombuffer(message.intensity_roots, np.uint8) / 255) ** 2
    return (message.intensity_greatest * shares).astype(np.float32)


def _roots(intensities: Vector) -> dict[str, object]:
    """The two fields; 0 for intensities that are negative or not finite."""
    known = np.maximum(np.nan_to_num(intensities.astype(np.float64), posinf=0.0), 0.0)
    greatest = known.max(initial=0.0)
    roots = np.rint(255 * np.sqrt(known / (greatest or 1.0))).astype(np.uint8)
    return {"intensity_greatest": greatest, "intensity_roots": roots.tobytes()}
