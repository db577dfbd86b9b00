"""Single scans from files: .bin, .npy, .ply, .pcd. All commands read them here."""

import math
from codecs import BOM_UTF8
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from segslam.core.errors import brief
from segslam.core.types import BadScan, SegslamError
from segslam.scans.dataset import Cloud
from segslam.scans.kitti import read_returns
from segslam.scans.pcd import parse_pcd
from segslam.scans.ply import parse_ply
from segslam.scans.records import read_records
from segslam.scans.scan_files import INTENSITY_FIELDS, NO_POINTS, TIME_FIELDS, Columns, read_bytes

SUFFIXES = (".bin", ".npy", ".ply", ".pcd")


def read_file(file: Path) -> Cloud:
    """The points of a file: .bin (float32 x y z intensity, or as in `records`), .npy (n, 3 or more), .ply, .pcd.

    Intensities are the fourth column of .bin and .npy, or a field with one of the usual names in .ply and .pcd.
    Raises SegslamError, naming the file: BadScan for one that is missing, invalid, truncated or too large.
    """
    try:
        match file.suffix.lower():
            case ".bin":
                columns = read_records(file)
                return _from_rows(read_returns(file)) if columns is None else from_columns(columns)
            case ".npy":
                return _from_rows(_parse_npy(read_bytes(file)))
            case ".ply":
                return from_columns(parse_ply(read_bytes(file).removeprefix(BOM_UTF8)))
            case ".pcd":
                return from_columns(parse_pcd(read_bytes(file).removeprefix(BOM_UTF8)))
            case other:
                raise SegslamError(f"{file}: unknown format {other or '(no extension)'}; give .bin, .npy, .ply or .pcd")
    except (ValueError, MemoryError) as error:
        raise BadScan(
            f"{file}: {str(error) or 'not enough memory'}; copy the file again, convert it, or remove it"
        ) from error


def _parse_npy(content: bytes) -> np.ndarray:
    """The array (n, k) of a .npy file, of at least three columns of plain numbers, as stored; else ValueError."""
    stream = BytesIO(content)
    try:
        is_first = npy.read_magic(stream) == (1, 0)
        shape, by_columns, kind = (npy.read_array_header_1_0 if is_first else npy.read_array_header_2_0)(stream)
    except Exception as error:  # of NumPy's parser, which raises many kinds
        what = brief(f"{type(error).__name__}: {error}")
        raise ValueError(f"it is not a .npy file, or its header is damaged ({what}); save it by numpy.save") from error
    if len(shape) != 2 or shape[0] < 0 or shape[1] < 3 or kind.kind not in "fiu" or kind.itemsize > 8:
        raise ValueError(f"it contains {brief(f'{kind} of shape {shape}')}; expected (n, 3) numbers, x y z")
    if shape[0] in (3, 4) and shape[1] > 100:  # no scan has as many values per point
        raise ValueError(
            f"its shape {shape} is transposed; expected (n, {shape[0]}), as numpy.save('NAME.npy', array.T)"
        )
    num_bytes = len(content) - stream.tell()
    if num_bytes != math.prod(shape) * kind.itemsize:
        raise ValueError(f"its header claims {shape} {kind}, but {num_bytes} bytes follow: truncated")
    if shape[0] == 0:
        raise ValueError(NO_POINTS)
    return np.frombuffer(content, kind, offset=stream.tell()).reshape(shape, order="F" if by_columns else "C")


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
    of_cloudcompare = {name.removeprefix("scalar_").lower(): values for name, values in columns.items()}
    named = of_cloudcompare | columns
    intensities = next((named[name] for name in INTENSITY_FIELDS if name in named), None)
    times = next((named[name] for name in TIME_FIELDS if name in named), np.empty(0))
    return Cloud(
        points, times.astype(np.float64), None if intensities is None else intensities.astype(_kind(intensities))
    )


def _kind(values: np.ndarray) -> type[np.floating]:
    """Type, in the byte order of this machine, that holds the values."""
    return np.float32 if values.dtype.kind == "f" and values.dtype.itemsize <= 4 else np.float64
