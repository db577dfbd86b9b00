"""The points around the sensor, a few a voxel, as KISS-ICP's voxel map keeps them."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from segslam import geometry
from segslam.types import Indices, Points, Transform

EMPTY = -1
"""Of a slot in the table, and the row of a voxel that is not in the map."""
MIN_TABLE = 2**12


class Voxels(NamedTuple):
    """Occupied voxels, a row each, and a hash table of their rows that, unlike that of `points`, can grow."""

    table: np.ndarray
    """(power of 2,) int32: row of the voxel, or EMPTY; open addressing, at most half full."""
    keys: Indices
    """(n,) the voxel's place in space."""
    counts: Indices
    """(n,) points in it."""
    points: np.ndarray
    """(n, most, 3) float64."""


class LocalMap:
    """KISS-ICP's local map, point for point: `update` stands in for its own."""

    def __init__(self, *, voxel_m: float, max_range_m: float, max_points_per_voxel: int) -> None:
        self.voxel_m = voxel_m
        self.voxels = Voxels(
            np.full(MIN_TABLE, EMPTY, np.int32),
            np.empty(0, np.int64),
            np.empty(0, np.int64),
            np.empty((0, max_points_per_voxel, 3)),
        )
        self.num_voxels = 0
        self._max_range_m = max_range_m

    def __len__(self) -> int:
        """Number of points."""
        return int(self.voxels.counts[: self.num_voxels].sum())

    def update(self, points: Points, T_odom_lidar: Transform) -> None:
        """Add a scan taken at this pose, and forget the voxels that begin out of range of it.

        A voxel takes up to its number of points, each at least as far from the others as evenly spread ones would be.
        """
        self._make_room(self.num_voxels + len(points))
        most = self.voxels.points.shape[1]
        spacing_m = math.sqrt(self.voxel_m**2 / most)
        moved = geometry.apply(T_odom_lidar, points)
        num_voxels = _add(self.voxels, self.num_voxels, moved, self.voxel_m, spacing_m**2)
        x, y, z = T_odom_lidar[:3, 3]
        self.num_voxels = _forget(self.voxels, num_voxels, x, y, z, self._max_range_m**2)

    def _make_room(self, num_voxels: int) -> None:
        """Room for so many voxels, twice as much as now at least, so that growing is rare."""
        _, keys, counts, points = self.voxels
        if num_voxels <= len(keys):
            return
        room = max(num_voxels, 2 * len(keys))
        table = np.full(1 << (2 * room).bit_length(), EMPTY, np.int32)
        self.voxels = Voxels(table, _grown(keys, room), _grown(counts, room), _grown(points, room))
        _number(self.voxels, self.num_voxels)


def _grown(rows: np.ndarray, num_rows: int) -> np.ndarray:
    grown = np.empty((num_rows, *rows.shape[1:]), rows.dtype)
    grown[: len(rows)] = rows
    return grown


@njit("int64(int64, int64, int64)", cache=True, nogil=True)
def _key(x, y, z):
    """A number for a voxel; the same again after two million voxels in any direction."""
    bits = 0x1FFFFF
    return (x & bits) << 42 | (y & bits) << 21 | (z & bits)


@njit("int64(int32[::1], int64[::1], int64)", cache=True, nogil=True)
def _slot(table, keys, key):
    """Where in the table the key's row is, or would be."""
    last = len(table) - 1
    slot = (key * 0x9E3779B97F4A7C1 >> 20) & last
    while table[slot] != EMPTY and keys[table[slot]] != key:
        slot = (slot + 1) & last
    return slot


@njit(cache=True, nogil=True)
def _number(voxels, num_voxels):
    """Fill the table anew."""
    voxels.table[:] = EMPTY
    for row in range(num_voxels):
        voxels.table[_slot(voxels.table, voxels.keys, voxels.keys[row])] = row


@njit(cache=True, nogil=True)
def _squared(points, row, place, x, y, z):
    """Squared distance from a kept point."""
    dx, dy, dz = points[row, place, 0] - x, points[row, place, 1] - y, points[row, place, 2] - z
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _has_place(voxels, row, x, y, z, squared_spacing):
    """Whether a voxel takes one more point."""
    count = voxels.counts[row]
    if count == voxels.points.shape[1]:
        return False
    for place in range(count):  # noqa: SIM110  (numba compiles no generators)
        if _squared(voxels.points, row, place, x, y, z) < squared_spacing:
            return False
    return True


@njit(cache=True, nogil=True)
def _add(voxels, num_voxels, points, voxel_m, squared_spacing):
    """Add points in their order; the new number of voxels, for which there is room."""
    table, keys, counts, kept = voxels
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        key = _key(math.floor(x / voxel_m), math.floor(y / voxel_m), math.floor(z / voxel_m))
        slot = _slot(table, keys, key)
        if table[slot] == EMPTY:
            table[slot], keys[num_voxels], counts[num_voxels] = num_voxels, key, 0
            num_voxels += 1
        row = table[slot]
        if _has_place(voxels, row, x, y, z, squared_spacing):
            place = counts[row]
            kept[row, place, 0], kept[row, place, 1], kept[row, place, 2] = x, y, z
            counts[row] = place + 1
    return num_voxels


@njit(cache=True, nogil=True)
def _forget(voxels, num_voxels, x, y, z, squared_range):
    """Drop the voxels whose first point is out of range of a position; the new number of voxels."""
    num_kept = 0
    for row in range(num_voxels):
        if _squared(voxels.points, row, 0, x, y, z) < squared_range:
            if num_kept < row:
                _move(voxels, row, num_kept)
            num_kept += 1
    if num_kept < num_voxels:
        _number(voxels, num_kept)
    return num_kept


@njit(cache=True, nogil=True)
def _move(voxels, row, to_row):
    voxels.keys[to_row], voxels.counts[to_row] = voxels.keys[row], voxels.counts[row]
    for place in range(voxels.counts[row]):
        for axis in range(3):
            voxels.points[to_row, place, axis] = voxels.points[row, place, axis]


@njit(cache=True, nogil=True)
def nearest(voxels, voxel_m, x, y, z, squared_bound):
    """The nearest point in the 27 voxels around a point: its voxel's row, its place there, and the squared distance.

    The row is EMPTY if none is nearer than the bound. Voxels farther than the nearest so far are not looked at.
    """
    at_x, at_y, at_z = math.floor(x / voxel_m), math.floor(y / voxel_m), math.floor(z / voxel_m)
    best_row, best_place, best = EMPTY, 0, squared_bound
    for dx in (0, -1, 1):
        gap_x = _squared_gap(dx, x - at_x * voxel_m, voxel_m)
        for dy in (0, -1, 1):
            gap_xy = gap_x + _squared_gap(dy, y - at_y * voxel_m, voxel_m)
            for dz in (0, -1, 1):
                if gap_xy + _squared_gap(dz, z - at_z * voxel_m, voxel_m) >= best:
                    continue
                row = voxels.table[_slot(voxels.table, voxels.keys, _key(at_x + dx, at_y + dy, at_z + dz))]
                if row == EMPTY:
                    continue
                for place in range(voxels.counts[row]):
                    squared = _squared(voxels.points, row, place, x, y, z)
                    if squared < best:
                        best_row, best_place, best = row, place, squared
    return best_row, best_place, best


@njit("float64(int64, float64, float64)", cache=True, nogil=True)
def _squared_gap(step, into, voxel_m):
    """To the neighbouring voxel on one side along an axis, from a point so far into its own."""
    if step == 0:
        return 0.0
    return into * into if step < 0 else (voxel_m - into) * (voxel_m - into)
