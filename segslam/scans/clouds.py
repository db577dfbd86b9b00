"""Single scans from files: .bin, .npy, .ply, .pcd. All commands read them here."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segslam.core.types import BadScan, Points, SegslamError, Vector
from segslam.scans.kitti import read_returns
from segslam.scans.npy import parse_npy
from segslam.scans.pcd import parse_pcd
from segslam.scans.ply import parse_ply
from segslam.scans.point_cloud2 import INTENSITY_FIELDS, TIME_FIELDS
from segslam.scans.scan_files import Columns, read_bytes

SUFFIXES = (".bin", ".npy", ".ply", ".pcd")
TIMES = (*TIME_FIELDS, "timestamps", "stamps")
"""Names of the field with the time of a point; the first that exists is used."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points of a file, as stored: float32 if the file has this type, otherwise float64."""

    points: Points
    times: Vector
    """(n,) in any unit, from any origin; empty if the file has none."""
    intensities: Vector | None
    """The fourth column of .bin and .npy, a field with one of the usual names in .ply and .pcd; None without."""


def read_file(file: Path) -> Cloud:
    """The points of a file: .bin (float32 x y z intensity), .npy (n, 3 or more), .ply, .pcd.

    Raises SegslamError, naming the file: BadScan for one that is missing, invalid, truncated or too large.
    """
    try:
        match file.suffix:
            case ".bin":
                return _from_rows(read_returns(file))
            case ".npy":
                return _from_rows(parse_npy(read_bytes(file)))
            case ".ply":
                return _from_columns(parse_ply(read_bytes(file)))
            case ".pcd":
                return _from_columns(parse_pcd(read_bytes(file)))
            case other:
                raise SegslamError(f"{file}: unknown format {other or '(no extension)'}; give .bin, .npy, .ply or .pcd")
    except (ValueError, MemoryError) as error:
        raise BadScan(
            f"{file}: {str(error) or 'not enough memory'}; copy the file again, convert it, or remove it"
        ) from error


def read_cloud(file: Path) -> Points:
    """The points (n, 3) of a file. Raises SegslamError as `read_file` does."""
    return read_file(file).points


def read_intensities(file: Path) -> Vector | None:
    """Intensities (n,) of a file; None if it has none. Raises SegslamError as `read_file` does."""
    return read_file(file).intensities


def _from_rows(rows: np.ndarray) -> Cloud:
    if rows.dtype != np.float32:
        rows = rows.astype(np.float64)
    return Cloud(rows[:, :3], np.empty(0), rows[:, 3] if rows.shape[1] > 3 else None)


def _from_columns(columns: Columns) -> Cloud:
    """Raises ValueError without x, y and z, and without any point."""
    if not {"x", "y", "z"} <= set(columns):
        raise ValueError(f"it has no fields x y z, only {' '.join(columns)[:80] or 'none'}")
    if len(columns["x"]) == 0:
        raise ValueError("it has no points")
    intensities = next((columns[name] for name in INTENSITY_FIELDS if name in columns), None)
    times = next((columns[name] for name in TIMES if name in columns), np.empty(0))
    return Cloud(
        _stacked([columns[axis] for axis in "xyz"]),
        times.astype(np.float64),
        None if intensities is None else _float(intensities),
    )


def _stacked(axes: list[np.ndarray]) -> Points:
    dtype = np.float32 if all(axis.dtype.kind == "f" and axis.dtype.itemsize <= 4 for axis in axes) else np.float64
    points = np.empty((len(axes[0]), 3), dtype)
    for k, axis in enumerate(axes):
        points[:, k] = axis
    return points


def _float(values: np.ndarray) -> Vector:
    """The values as float32 or float64 in the byte order of this machine."""
    return values.astype(np.float32 if values.dtype.itemsize <= 4 and values.dtype.kind == "f" else np.float64)
