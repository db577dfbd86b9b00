"""Benchmark of place recognition: how often a query finds its place in a database of scans, in top view."""

import math
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from zipfile import BadZipFile, is_zipfile

import numpy as np
from jaxtyping import Float, UInt8

from segslam.candidates import Places, signature_of_standing
from segslam.core import geometry
from segslam.core.errors import unreadable
from segslam.core.processes import Progress, no_progress
from segslam.core.types import Points, SegslamError

CELL_M = 0.4
"""Size of a cell of the columns, and height of its voxels."""
HIT_M = 5.0
SHORTLIST = 20
VALUE_OF_A_VOXEL = 25.5
"""Columns are proportional to the number of occupied voxels; 10 or more are 255."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenPlaces:
    """Scans in top view, and their poses."""

    columns: UInt8[np.ndarray, "n size size"]
    T_world_lidar: Float[np.ndarray, "n 3 4"]

    def __len__(self) -> int:
        return len(self.columns)

    def points(self, row: int, *, yaw_rad: float = 0.0) -> Points:
        """The occupied voxels of a row as points (n, 3), rotated about the vertical."""
        ahead, left = np.nonzero(self.columns[row])
        counts = np.rint(self.columns[row][ahead, left] / VALUE_OF_A_VOXEL).astype(np.int64)
        middle = self.columns.shape[1] // 2
        levels = np.concatenate([np.arange(count) for count in counts]) if len(counts) else np.empty(0)
        points = np.column_stack([np.repeat(middle - ahead, counts), np.repeat(middle - left, counts), levels])
        return points * CELL_M @ geometry.yaw(yaw_rad).T


def read_places(file: Path) -> SeenPlaces:
    """The places of a file. Raises SegslamError, naming the file, if it is invalid."""
    remedy = "give a file with `columns` (n, size, size) uint8 and `poses` (n, 3, 4)"
    try:
        if file.is_file() and not is_zipfile(file):
            raise ValueError("it is not a .npz file")
        with np.load(file) as stored:
            columns, poses = stored["columns"], stored["poses"].astype(np.float64)
    except (OSError, ValueError, KeyError, TypeError, BadZipFile, EOFError) as error:
        raise SegslamError(f"{unreadable(file, 'places', error)}; {remedy}") from error
    is_square = columns.ndim == 3 and columns.shape[1] == columns.shape[2]
    if not is_square or columns.dtype != np.uint8 or poses.shape != (len(columns), 3, 4):
        raise SegslamError(f"{file}: columns {columns.shape} {columns.dtype}, poses {poses.shape}; {remedy}")
    return SeenPlaces(columns, poses)


def parse_range(text: str, option: str, num_places: int) -> range:
    """The rows `A:B`, either end optional. Raises SegslamError, naming the option."""
    first, colon, end = text.partition(":")
    try:
        rows = range(int(first or 0), int(end or num_places))
    except ValueError:
        rows = range(0)
    if not colon or not 0 <= rows.start < rows.stop <= num_places:
        raise SegslamError(f"{option} {text}: give rows A:B, B excluded, of the {num_places} places")
    return rows


def measure(
    places: SeenPlaces,
    database: range,
    queries: range,
    *,
    turned_seed: int | None = None,
    progress: Progress = no_progress,
) -> dict[str, float]:
    """Recall of the queries, median time of a query, bytes per place of the database.

    A query counts if it is within 5 m of a place in the database; it is a hit if the found place is. `turned_seed`:
    seed of random yaws of the queries; None for no rotation. Raises SegslamError if no query counts.
    """
    index = Places()
    ranks: list[int | None] = []
    query_s: list[float] = []
    at = places.T_world_lidar[:, :, 3]
    database_at = at[list(database)]
    yaws = np.zeros(len(queries))
    if turned_seed is not None:
        yaws = np.random.default_rng(turned_seed).uniform(0.0, math.tau, len(queries))
    steps = [*((row, None) for row in database), *zip(queries, yaws.tolist(), strict=True)]
    for row, yaw_rad in progress(steps, len(steps), "bench places"):
        if yaw_rad is None:
            index.add(row, signature_of_standing(places.points(row)))
        elif np.linalg.norm(database_at - at[row], axis=1).min() <= HIT_M:
            signature = signature_of_standing(places.points(row, yaw_rad=yaw_rad))
            started = perf_counter()
            listed = index.shortlist(signature, most=SHORTLIST)
            query_s.append(perf_counter() - started)
            hits = (k for k, one in enumerate(listed) if np.linalg.norm(at[one.place_id] - at[row]) <= HIT_M)
            ranks.append(next(hits, None))
    if not ranks:
        raise SegslamError(f"no query is within {HIT_M:g} m of a place in the database; give other rows")
    return {
        "num_places": len(database),
        "num_queries": len(ranks),
        "recall_at_1": float(np.mean([rank == 0 for rank in ranks])),
        "recall_at_20": float(np.mean([rank is not None for rank in ranks])),
        "query_ms": 1000 * float(np.median(query_s)),
        "index_bytes": index.bytes_per_place,
    }
