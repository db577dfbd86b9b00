"""Records of options that several commands share: each field of the record is an option of the command."""

import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import wraps
from itertools import chain
from typing import Any


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the fields of its parameter `options`, a dataclass, in place of that parameter.

    Fields of the dataclass itself come before those of its bases.
    """
    own = inspect.signature(command, eval_str=True)
    record: type[Any] = own.parameters["options"].annotation
    shared = list(_fields(record))

    @wraps(command)
    def flat(**values: Any) -> None:
        command(**values, options=record(**{parameter.name: values.pop(parameter.name) for parameter in shared}))

    parameters = chain.from_iterable(shared if one.name == "options" else [one] for one in own.parameters.values())
    kept = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in parameters]
    flat.__signature__ = own.replace(parameters=kept)  # type: ignore[attr-defined]
    flat.__annotations__ = {one.name: one.annotation for one in kept}
    return flat


def _fields(record: type[Any]) -> Iterator[inspect.Parameter]:
    of_bases = {field.name for base in record.__bases__ if is_dataclass(base) for field in fields(base)}
    for field in sorted(fields(record), key=lambda field: field.name in of_bases):
        yield inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, annotation=field.type, default=field.default
        )
