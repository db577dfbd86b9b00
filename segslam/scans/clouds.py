"""Single scans from files: .bin, .npy, .ply, .pcd. All commands read them here."""

import ast
import math
import re
import struct
from pathlib import Path

import numpy as np

from segslam.core.types import BadScan, SegslamError
from segslam.scans.dataset import Cloud
from segslam.scans.kitti import read_returns
from segslam.scans.pcd import parse_pcd
from segslam.scans.ply import parse_ply
from segslam.scans.scan_files import INTENSITY_FIELDS, NO_POINTS, TIME_FIELDS, Columns, read_bytes

SUFFIXES = (".bin", ".npy", ".ply", ".pcd")
MAX_NPY_HEADER_BYTES = 10_000
"""As in NumPy: a longer header can make Python's parser fail."""


def read_file(file: Path) -> Cloud:
    """The points of a file: .bin (float32 x y z intensity), .npy (n, 3 or more), .ply, .pcd.

    Intensities are the fourth column of .bin and .npy, or a field with one of the usual names in .ply and .pcd.
    Raises SegslamError, naming the file: BadScan for one that is missing, invalid, truncated or too large.
    """
    try:
        match file.suffix:
            case ".bin":
                return _from_rows(read_returns(file))
            case ".npy":
                return _from_rows(_parse_npy(read_bytes(file)))
            case ".ply":
                return from_columns(parse_ply(read_bytes(file)))
            case ".pcd":
                return from_columns(parse_pcd(read_bytes(file)))
            case other:
                raise SegslamError(f"{file}: unknown format {other or '(no extension)'}; give .bin, .npy, .ply or .pcd")
    except (ValueError, MemoryError) as error:
        raise BadScan(
            f"{file}: {str(error) or 'not enough memory'}; copy the file again, convert it, or remove it"
        ) from error


def _parse_npy(content: bytes) -> np.ndarray:
    """The array (n, k) of a .npy file, of at least three columns of plain numbers, as stored.

    Raises ValueError for another content, and for a file whose size is not that of the array.
    """
    if not content.startswith(b"\x93NUMPY") or len(content) < 12:
        raise ValueError("it is not a .npy file; save an array by numpy.save")
    size, start = ("<H", 10) if content[6] == 1 else ("<I", 12)
    (num_header,) = struct.unpack_from(size, content, 8)
    if num_header > MAX_NPY_HEADER_BYTES or start + num_header > len(content):
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
    if not re.fullmatch(r"[<>|=]?[fiu][1248]", kind) or kind[-2:] == "f1" or columns < 3 or rows < 0:
        raise ValueError(f"it contains {kind[:20]} of shape ({rows}, {columns}); expected (n, 3) numbers, x y z")
    start += num_header
    num_bytes = len(content) - start
    if num_bytes != math.prod((rows, columns, np.dtype(kind).itemsize)):
        raise ValueError(f"its header claims {rows} x {columns} {kind}, but {num_bytes} bytes follow: truncated")
    if rows == 0:
        raise ValueError(NO_POINTS)
    return np.frombuffer(content, kind, offset=start).reshape((rows, columns), order="F" if by_columns else "C")


def _from_rows(rows: np.ndarray) -> Cloud:
    if rows.dtype != np.float32:
        rows = rows.astype(np.float64)
    return Cloud(rows[:, :3], np.empty(0), rows[:, 3] if rows.shape[1] > 3 else None)


def from_columns(columns: Columns) -> Cloud:
    """The cloud of named fields, (n,) each. Raises ValueError without x, y and z."""
    if not {"x", "y", "z"} <= set(columns):
        raise ValueError(f"it has no fields x y z, only {' '.join(columns)[:80] or 'none'}")
    axes = [columns[axis] for axis in "xyz"]
    points = np.empty((len(axes[0]), 3), np.result_type(*map(_kind, axes)))
    for k, axis in enumerate(axes):
        points[:, k] = axis
    intensities = next((columns[name] for name in INTENSITY_FIELDS if name in columns), None)
    times = next((columns[name] for name in TIME_FIELDS if name in columns), np.empty(0))
    return Cloud(
        points, times.astype(np.float64), None if intensities is None else intensities.astype(_kind(intensities))
    )


def _kind(values: np.ndarray) -> type[np.floating]:
    """Type, in the byte order of this machine, that holds the values."""
    return np.float32 if values.dtype.kind == "f" and values.dtype.itemsize <= 4 else np.float64
