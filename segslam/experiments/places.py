"""Recognition of places: how often a place of a database is found again, on scans seen from above."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float, UInt8

from segslam import geometry
from segslam.retrieval import Places, signature_of_standing
from segslam.types import Points, SegslamError

CELL_M = 0.4
"""Edge of a cell of the columns, and height of the voxels counted in it."""
HIT_M = 5.0
SHORTLIST = 20
VALUE_OF_A_VOXEL = 25.5
"""The columns are proportional to the occupied voxels; 10 of them, or more, are 255."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenPlaces:
    """Scans seen from above, and where they were taken."""

    columns: UInt8[np.ndarray, "n size size"]
    T_world_lidar: Float[np.ndarray, "n 3 4"]

    def __len__(self) -> int:
        return len(self.columns)

    def points(self, row: int, *, yaw_rad: float = 0.0) -> Points:
        """The columns of one as points, one a voxel, turned about the vertical."""
        ahead, left = np.nonzero(self.columns[row])
        counts = np.rint(self.columns[row][ahead, left] / VALUE_OF_A_VOXEL).astype(np.int64)
        middle = self.columns.shape[1] // 2
        levels = np.concatenate([np.arange(count) for count in counts]) if len(counts) else np.empty(0)
        points = np.column_stack([np.repeat(middle - ahead, counts), np.repeat(middle - left, counts), levels])
        return points * CELL_M @ geometry.yaw(yaw_rad).T


def read_places(file: Path) -> SeenPlaces:
    """The places of a file. Raises SegslamError, which names it, if it holds none."""
    remedy = "give a file with `columns` (n, size, size) uint8 and `poses` (n, 3, 4)"
    try:
        with np.load(file) as stored:
            columns, poses = stored["columns"], stored["poses"].astype(np.float64)
    except (OSError, ValueError, KeyError, BadZipFile, EOFError) as error:
        raise SegslamError(f"{file}: cannot read places ({error}); {remedy}") from error
    is_square = columns.ndim == 3 and columns.shape[1] == columns.shape[2]
    if not is_square or columns.dtype != np.uint8 or poses.shape != (len(columns), 3, 4):
        raise SegslamError(f"{file}: columns {columns.shape} {columns.dtype}, poses {poses.shape}; {remedy}")
    return SeenPlaces(columns, poses)


def parse_range(text: str, option: str, num_places: int) -> range:
    """The rows `A:B`, where each end may be left out. Raises SegslamError, which names the option."""
    first, colon, end = text.partition(":")
    try:
        rows = range(int(first or 0), int(end or num_places))
    except ValueError:
        rows = range(0)
    if not colon or not rows or not 0 <= rows.start < rows.stop <= num_places:
        raise SegslamError(f"{option} {text}: give rows A:B, B not included, of the {num_places} places")
    return rows


class PlacesBench:
    """Scores queries of a range of places against a database of another."""

    def __init__(self, places: SeenPlaces, database: range, queries: range, *, turned_seed: int | None) -> None:
        """Queries are turned by random yaws if there is a seed for them."""
        self._places, self._database, self._queries = places, database, queries
        self._yaws = (
            np.zeros(len(queries))
            if turned_seed is None
            else np.random.default_rng(turned_seed).uniform(0.0, math.tau, len(queries))
        )
        self._index = Places()
        self._ranks: list[int | None] = []
        self._query_seconds: list[float] = []

    @property
    def num_steps(self) -> int:
        """Places to go through."""
        return len(self._database) + len(self._queries)

    def run(self) -> Iterator[None]:
        """Fills the database and asks the queries that have a place of it within 5 m, step by step."""
        for row in self._database:
            self._index.add(row, signature_of_standing(self._places.points(row)))
            yield
        at = self._places.T_world_lidar[:, :, 3]
        database_at = at[list(self._database)]
        for row, yaw_rad in zip(self._queries, self._yaws.tolist(), strict=True):
            if np.linalg.norm(database_at - at[row], axis=1).min() <= HIT_M:
                signature = signature_of_standing(self._places.points(row, yaw_rad=yaw_rad))
                started = perf_counter()
                listed = self._index.shortlist(signature, most=SHORTLIST)
                self._query_seconds.append(perf_counter() - started)
                hits = (k for k, one in enumerate(listed) if np.linalg.norm(at[one.place_id] - at[row]) <= HIT_M)
                self._ranks.append(next(hits, None))
            yield

    def figures(self) -> dict[str, float]:
        """Recall among the queries that count, median time of a query, bytes of a place.

        Raises SegslamError if no query counts.
        """
        if not self._ranks:
            raise SegslamError(f"no query has a place of the database within {HIT_M:g} m; give other rows")
        return {
            "num_places": len(self._database),
            "num_queries": len(self._ranks),
            "recall_at_1": float(np.mean([rank == 0 for rank in self._ranks])),
            "recall_at_20": float(np.mean([rank is not None for rank in self._ranks])),
            "query_ms": 1000 * float(np.median(self._query_seconds)),
            "index_bytes": self._index.bytes_per_place,
        }
