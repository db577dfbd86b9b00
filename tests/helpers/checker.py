"""The run-time check of types and shapes in the test run: jaxtyping and beartype, for the first calls in each test.

Functions of geometry are called a hundred thousand times in a test of a drive: if all calls were checked, the tests
would take a third longer.
"""

import math
import os
from collections.abc import Callable
from functools import wraps
from inspect import isfunction
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

MOST_CALLS = math.inf if "SEGSLAM_CHECK_ALL_CALLS" in os.environ else 5
"""Number of calls of a function that are checked in each test; all in `.ci/run`."""

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""Accepts int for float, as in PEP 484."""

_always_checked = jaxtyping.jaxtyped
_test = 0


def begin_test() -> None:
    """Check the next calls of every function again."""
    global _test
    _test += 1


def _checked_at_first(*, typechecker: Callable[..., Any]) -> Callable[[Any], Any]:
    """In place of `jaxtyping.jaxtyped`; what is no plain function is always checked."""

    def decorate(function: Any) -> Any:
        if not isfunction(function):
            return _always_checked(function, typechecker=typechecker)
        checked, test, calls = None, -1, 0

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal checked, test, calls
            if test != _test:
                test, calls = _test, 0
            if calls >= MOST_CALLS:
                return function(*args, **kwargs)
            calls += 1
            checked = checked or _always_checked(function, typechecker=typechecker)  # compiled at the first call
            return checked(*args, **kwargs)

        return call

    return decorate


jaxtyping.jaxtyped = _checked_at_first
