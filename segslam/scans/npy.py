"""Arrays of NumPy's .npy files, of which only plain numbers are read."""

import ast
import math
import re
import struct

import numpy as np

MAGIC = b"\x93NUMPY"
NUMBER = re.compile(r"[<>|=]?[fiu][1248]")
MAX_HEADER_BYTES = 10_000
"""As in NumPy: a longer header can make Python's parser fail."""


def parse_npy(content: bytes) -> np.ndarray:
    """The array (n, k), of at least three columns of numbers, as stored.

    Raises ValueError for another content, and for a file whose size is not that of the array.
    """
    if not content.startswith(MAGIC) or len(content) < 12:
        raise ValueError("it is not a .npy file; save an array by numpy.save")
    size, start = ("<H", 10) if content[6] == 1 else ("<I", 12)
    (num_header,) = struct.unpack_from(size, content, 8)
    if num_header > MAX_HEADER_BYTES or start + num_header > len(content):
        raise ValueError("its header is damaged or truncated")
    try:
        header = ast.literal_eval(content[start : start + num_header].decode("latin-1").strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(f"its header is damaged ({type(error).__name__})") from error
    match header:
        case {"descr": str(kind), "fortran_order": bool(by_columns), "shape": (int(rows), int(columns))}:
            pass
        case _:
            raise ValueError("its array is not of the shape (n, 3) or more, or not of plain numbers, x y z")
    if not NUMBER.fullmatch(kind) or kind[-2:] == "f1" or columns < 3 or rows < 0:
        raise ValueError(f"it contains {kind[:20]} of shape ({rows}, {columns}); expected (n, 3) numbers, x y z")
    start += num_header
    num_bytes = len(content) - start
    if num_bytes != math.prod((rows, columns, np.dtype(kind).itemsize)):
        raise ValueError(f"its header claims {rows} x {columns} {kind}, but {num_bytes} bytes follow: truncated")
    if rows == 0:
        raise ValueError("it has no points")
    return np.frombuffer(content, kind, offset=start).reshape((rows, columns), order="F" if by_columns else "C")
