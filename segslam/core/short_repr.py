"""Short representations of records with arrays."""

from dataclasses import fields
from typing import Any

import numpy as np

FEW = 3


class Record:
    """Base of dataclasses with arrays; a representation of one line."""

    __slots__ = ()

    def __repr__(self) -> str:
        parts = (f"{field.name}={_short(getattr(self, field.name))}" for field in fields(self))  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(parts)})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return _pose(value) if value.shape == (4, 4) else f"<{value.dtype} {value.shape}>"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (tuple, list, dict)) and len(value) > FEW:
        return f"<{len(value)} in a {type(value).__name__}>"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {_short(one)}" for key, one in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return f"({', '.join(_short(one) for one in value)})"
    return repr(value)


def _pose(T_a_b: np.ndarray) -> str:
    cosine = np.clip((np.trace(T_a_b[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
    x, y, z = T_a_b[:3, 3]
    return f"<{x:.2f} {y:.2f} {z:.2f} m, turned {np.degrees(np.arccos(cosine)):.1f} deg>"
