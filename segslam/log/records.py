"""Records as JSON with a JSON Schema, and back without loss: Python's JSON keeps every digit of a float64.

Each record becomes an object with a key for each of its fields: the records of `segslam.types` define the format.
Arrays are nested lists, row by row; a mapping with tuples for keys becomes rows [key ..., value]. What is bulky travels
in binary messages beside the JSON, which leaves it out: see `BULK`.
"""

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import AbstractArray

from segslam.types import GraphEstimate, Keyframe, Step

Bulk = Mapping[type, Mapping[str, Any]]
"""Values of the fields that the JSON leaves out, by record."""

BULK: Mapping[type, frozenset[str]] = {
    Step: frozenset({"estimate"}),
    Keyframe: frozenset({"points", "labels"}),
    GraphEstimate: frozenset({"T_world_keyframe"}),
}
"""Fields that the JSON leaves out."""

_NUMBERS = {bool: "boolean", int: "integer", float: "number", str: "string"}


def to_json(value: Any) -> Any:
    """A record, or the value of one of its fields, as what `json` writes."""
    if _is_record(value):
        record: Any = type(value)
        return {name: to_json(getattr(value, name)) for name in _hints(record)}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping) and value and isinstance(next(iter(value)), tuple):
        return [[*key, to_json(item)] for key, item in value.items()]
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(item) for item in value]
    return value


def from_json(hint: Any, value: Any, bulk: Bulk) -> Any:
    """The value of type `hint` that `to_json` wrote, with what it left out.

    Raises ValueError, TypeError or KeyError where the JSON does not hold such a value, or `bulk` lacks what it needs.
    """
    if _is_record(hint):
        return _record_from_json(hint, value, bulk)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return from_json(_alternative(arguments, value), value, bulk)
    if origin is tuple:
        return tuple(from_json(arguments[0], item, bulk) for item in value)
    if origin is dict and get_origin(arguments[0]) is tuple:
        return {tuple(row[:-1]): from_json(arguments[1], row[-1], bulk) for row in value}
    if origin is dict:
        return {key: from_json(arguments[1], item, bulk) for key, item in value.items()}
    if _is_array(hint):
        return np.asarray(value, dtype=np.float64 if "float64" in hint.dtypes else np.int64)
    return None if value is None else hint(value)


def json_schema(hint: Any) -> dict[str, Any]:
    """The JSON Schema of what `to_json` makes of a `hint`."""
    if _is_record(hint):
        properties = {name: json_schema(field) for name, field in _hints(hint).items()}
        return {"title": hint.__name__, "type": "object", "properties": properties, "required": list(properties)}
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return {"oneOf": [json_schema(argument) for argument in arguments]}
    if origin is tuple:
        return {"type": "array", "items": json_schema(arguments[0])}
    if origin is dict and get_origin(arguments[0]) is tuple:
        return {"type": "array", "items": {"type": "array", "items": {"type": "number"}}}
    if origin is dict:
        return {"type": "object", "additionalProperties": json_schema(arguments[1])}
    if _is_array(hint):
        return _array_schema(hint)
    if issubclass(hint, Enum):
        return {"type": "string", "enum": [member.value for member in hint]}
    return {"type": "null"} if hint is types.NoneType else {"type": _NUMBERS[hint]}


def _record_from_json(record: Any, value: Any, bulk: Bulk) -> Any:
    hints = _hints(record)
    values = {name: from_json(hints[name], value[name], bulk) for name in hints}
    return record(**values, **(bulk[record] if record in BULK else {}))


def _alternative(hints: tuple[Any, ...], value: Any) -> Any:
    """Which of the types of a union a value is of: a record is known by its keys."""
    if value is None:
        return types.NoneType
    for hint in hints:
        if _is_record(hint) and set(value) == set(_hints(hint)):
            return hint
    raise ValueError(f"no such record: {', '.join(map(str, value))}")


@cache
def _hints(record: Any) -> dict[str, Any]:
    """The fields of a record that its JSON holds, with their types."""
    hints = get_type_hints(record)
    return {field.name: hints[field.name] for field in fields(record) if field.name not in BULK.get(record, ())}


def _is_record(value_or_hint: Any) -> bool:
    return is_dataclass(value_or_hint)


def _is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray)


def _array_schema(hint: Any) -> dict[str, Any]:
    """Nested arrays of numbers; a dimension of fixed size says so."""
    schema: dict[str, Any] = {"type": "number" if "float64" in hint.dtypes else "integer"}
    for size in reversed(hint.dim_str.split()):
        schema = {"type": "array", "items": schema}
        if size.isdigit():
            schema |= {"minItems": int(size), "maxItems": int(size)}
    return schema
