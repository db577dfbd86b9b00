"""Functions on point clouds as arrays."""

import math
from typing import NamedTuple

import numpy as np

from segslam.core.kernels import kernel
from segslam.core.types import Covariances, Indices, Points

MAX_CELLS = 2**62
"""Largest number of voxels that int64 keys can number."""


class Neighbours(NamedTuple):
    """The neighbours of point i, itself among them, are `rows[starts[i] : ends[i]]`."""

    starts: Indices
    ends: Indices
    rows: Indices


def within_range(points: Points, min_m: float, max_m: float) -> np.ndarray:
    """(n,) bool: strictly farther than `min_m` and nearer than `max_m` from the origin; false for NaN."""
    squared = squared_ranges(points)
    return (squared > min_m**2) & (squared < max_m**2)


def squared_ranges(points: Points) -> np.ndarray:
    """(n,) squared distances from the origin (m^2); not finite if a coordinate is not."""
    with np.errstate(over="ignore"):
        x, y, z = points.T  # column by column: sums along rows of three take five times as long
        squared: np.ndarray = x * x + y * y + z * z
    return squared


def is_finite(points: Points) -> np.ndarray:
    """(n,) bool: whether all of a point's coordinates are."""
    x, y, z = np.isfinite(points).T
    return x & y & z


def canonical_order(points: Points) -> Indices:
    """Indices that sort points along a skew direction; the sorted sequence does not depend on the input order."""
    x, y, z = points.T.astype(np.float64)
    return np.argsort(x + math.sqrt(2.0) * y + math.sqrt(3.0) * z)


def voxel_first(points: Points, voxel_m: float) -> Indices:
    """Indices, ascending, of the first point in each occupied voxel; points that are not finite are ignored.

    Raises ValueError if voxel_m <= 0, or if the points span more voxels than int64 keys can number.
    """
    rows = np.flatnonzero(is_finite(points))
    keys, _ = cell_keys(points.take(rows, axis=0), voxel_m)
    return rows[first_rows(keys) == np.arange(len(keys))]


def voxel_means(points: Points, voxel_m: float, *, beyond_m: float = -1.0, within_m: float = math.inf) -> Points:
    """Mean (m, 3), float64, of the finite points in each occupied voxel; voxels are ordered by x, y, z.

    Only points strictly between two ranges count (`within_range`). The result does not depend on the order of float32
    points: their sums are exact, but for coordinates below 1e-5 m. Raises ValueError as `voxel_first` does.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    squared = beyond_m * abs(beyond_m), within_m**2
    lows_m, highs_m = _bounds(points, *squared)
    lows, extent = _grid(lows_m, highs_m, voxel_m)
    return _voxel_means(points, *squared, voxel_m, lows, extent)


def group_means(rows: np.ndarray, group: Indices, num_groups: int) -> np.ndarray:
    """Mean row of each group, float64; zeros for an empty group."""
    sums = [np.bincount(group, weights=column, minlength=num_groups) for column in rows.T]
    return np.column_stack(sums) / np.maximum(np.bincount(group, minlength=num_groups), 1)[:, None]


def group_moments(points: Points, group: Indices, num_groups: int) -> tuple[Points, Covariances]:
    """Mean and covariance (normalised by n) of the points of each group; zeros for an empty group."""
    means = group_means(points, group, num_groups)
    centred = points - means[group]
    products = (centred[:, :, None] * centred[:, None, :]).reshape(-1, 9)
    return means, group_means(products, group, num_groups).reshape(-1, 3, 3)


def radius_neighbours(points: Points, radius_m: float) -> Neighbours:
    """All neighbours within a radius, the limit included. The points are finite. Raises as `voxel_first` does."""
    keys, strides = cell_keys(points, radius_m)
    order = np.argsort(keys, kind="stable")
    return Neighbours(*_neighbours(points.astype(np.float64)[order], keys[order], *strides, order, radius_m**2))


def normals(points: Points, covariances: Covariances) -> Points:
    """Normal (n, 3) of each point: direction of least variance in its patch, towards the sensor at the origin.

    Zero if this direction is not unique, as for duplicates or points on a line along an axis.
    """
    directions = _least_directions(covariances)
    away = np.einsum("ij,ij->i", directions, points) > 0
    return np.where(away[:, None], -directions, directions)


def cell_keys(points: Points, cell_m: float) -> tuple[Indices, tuple[int, int]]:
    """A number for each point's cell floor(p / cell_m), and its increments to the next cell in x and in y (in z: 1).

    The numbers ascend with x, then y, then z. A margin around the points ensures that all neighbouring cells have
    distinct numbers.
    """
    coordinates = np.ascontiguousarray(points.T)
    bounds = coordinates if len(points) else np.zeros((3, 1))
    lows, (_, num_y, num_z) = _grid(bounds.min(axis=1), bounds.max(axis=1), cell_m)
    x, y, z = (
        (np.floor(column / cell_m) - low).astype(np.int64) for column, low in zip(coordinates, lows, strict=True)
    )
    return (x * num_y + y) * num_z + z, (int(num_y * num_z), int(num_z))


def _grid(lows_m: np.ndarray, highs_m: np.ndarray, cell_m: float) -> tuple[Indices, Indices]:
    """Lowest cells and numbers of cells (3,) of a grid with room around points between two corners."""
    if cell_m <= 0:
        raise ValueError(f"voxel_m or radius_m must be above 0, got {cell_m}")
    lows = np.floor(lows_m / cell_m) - 1
    extent = [int(number) + 2 for number in np.floor(highs_m / cell_m) - lows]
    if math.prod(extent) > MAX_CELLS:
        raise ValueError(f"points span {extent} cells of {cell_m} m; remove far points or enlarge the cells")
    return lows.astype(np.int64), np.array(extent)


@kernel("UniTuple(float64[::1], 2)(float64[:, ::1], float64, float64)")
def _bounds(points, beyond_squared, within_squared):
    """Least and greatest coordinates of the points between two ranges; zeros if there is none."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if beyond_squared < x * x + y * y + z * z < within_squared:
            low[0], low[1], low[2] = min(low[0], x), min(low[1], y), min(low[2], z)
            high[0], high[1], high[2] = max(high[0], x), max(high[1], y), max(high[2], z)
    if low[0] > high[0]:
        return np.zeros(3), np.zeros(3)
    return low, high


@kernel("float64[:, ::1](float64[:, ::1], float64, float64, float64, int64[::1], int64[::1])")
def _voxel_means(points, beyond_squared, within_squared, voxel_m, lows, extent):
    """The mean point of each voxel; `lows` and `extent` are those of `_grid`."""
    rows, keys = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    count = 0
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if beyond_squared < x * x + y * y + z * z < within_squared:
            i = int(np.floor(x / voxel_m)) - lows[0]
            j = int(np.floor(y / voxel_m)) - lows[1]
            keys[count] = (i * extent[1] + j) * extent[2] + int(np.floor(z / voxel_m)) - lows[2]
            rows[count] = k
            count += 1
    first = first_rows(keys[:count])
    sums = np.zeros((count, 4))
    for k in range(count):
        group, point = sums[first[k]], points[rows[k]]
        group[0] += point[0]
        group[1] += point[1]
        group[2] += point[2]
        group[3] += 1.0
    occupied = np.flatnonzero(first == np.arange(count))
    order = occupied[np.argsort(keys[occupied])]
    return sums[order, :3] / sums[order, 3:]


@kernel("int64[:](int64[:])")
def first_rows(keys):
    """For each row the first row with the same key, by a hash table with open addressing."""
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, -1, np.int64)
    first = np.empty(len(keys), np.int64)
    for row in range(len(keys)):
        slot = (keys[row] * 0x9E3779B97F4A7C1 >> 20) & (size - 1)
        while table[slot] >= 0 and keys[table[slot]] != keys[row]:
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = row
        first[row] = table[slot]
    return first


@kernel("Tuple((int64[:], int64[:], int32[:]))(float64[:, :], int64[:], int64, int64, int64[:], float64)")
def _neighbours(points, keys, stride_x, stride_y, row_of, squared_radius):
    """Neighbours of points sorted by key; `row_of` contains the original row of each point."""
    starts, ends = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    rows = np.empty(64 * len(points) + 1, np.int32)
    bounds = np.empty((9, 2), np.int64)  # rows of the cells around the point's own, in columns of three along z
    count = 0
    for at in range(len(points)):
        if at == 0 or keys[at] != keys[at - 1]:
            for column in range(9):
                middle = keys[at] + (column // 3 - 1) * stride_x + (column % 3 - 1) * stride_y
                bounds[column, 0] = np.searchsorted(keys, middle - 1)
                bounds[column, 1] = np.searchsorted(keys, middle + 2)
        starts[row_of[at]] = count
        for column in range(9):
            while count + bounds[column, 1] - bounds[column, 0] >= len(rows):
                rows = np.concatenate((rows, np.empty_like(rows)))
            for other in range(bounds[column, 0], bounds[column, 1]):
                x = points[other, 0] - points[at, 0]
                y = points[other, 1] - points[at, 1]
                z = points[other, 2] - points[at, 2]
                rows[count] = row_of[other]
                count += x * x + y * y + z * z <= squared_radius
        ends[row_of[at]] = count
    return starts, ends, rows[:count].copy()


@kernel("float64[:, :, :](float64[:, :], int64[:], int64[:], int32[:])")
def patch_covariances(points, starts, ends, rows):
    """Covariance (normalised by n) of the `Neighbours` of each point, itself among them."""
    covariances = np.empty((len(points), 3, 3))
    for row in range(len(points)):
        sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
        for at in range(starts[row], ends[row]):
            x = points[rows[at], 0] - points[row, 0]
            y = points[rows[at], 1] - points[row, 1]
            z = points[rows[at], 2] - points[row, 2]
            sx, sy, sz = sx + x, sy + y, sz + z
            xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
            yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
        n = ends[row] - starts[row]
        mx, my, mz = sx / n, sy / n, sz / n
        covariances[row, 0, 0] = xx / n - mx * mx
        covariances[row, 1, 1] = yy / n - my * my
        covariances[row, 2, 2] = zz / n - mz * mz
        covariances[row, 0, 1] = covariances[row, 1, 0] = xy / n - mx * my
        covariances[row, 0, 2] = covariances[row, 2, 0] = xz / n - mx * mz
        covariances[row, 1, 2] = covariances[row, 2, 1] = yz / n - my * mz
    return covariances


@kernel("float64[:, :](float64[:, ::1], int64[:, ::1])")
def patch_normals(points, patches):
    """Unit normal of each patch, the rows (k,) of its points; zero if it is not unique."""
    covariances = np.zeros((len(patches), 3, 3))
    for row in range(len(patches)):
        mean = np.zeros(3)
        for k in patches[row]:
            for axis in range(3):
                mean[axis] += points[k, axis] / patches.shape[1]
        for k in patches[row]:
            for i in range(3):
                for j in range(3):
                    covariances[row, i, j] += (points[k, i] - mean[i]) * (points[k, j] - mean[j])
    return _least_directions(covariances)


@kernel("float64(float64[:, :])")
def _least_eigenvalue(a):
    """Smallest eigenvalue of a symmetric matrix (Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961)."""
    mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
    squared = 2.0 * (a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2)
    for i in range(3):
        squared += (a[i, i] - mean) ** 2
    scale = math.sqrt(squared / 6.0)
    if scale == 0.0:
        return mean
    x, y, z = a[0, 0] - mean, a[1, 1] - mean, a[2, 2] - mean
    determinant = (
        x * (y * z - a[1, 2] ** 2)
        - a[0, 1] * (a[0, 1] * z - a[1, 2] * a[0, 2])
        + a[0, 2] * (a[0, 1] * a[1, 2] - y * a[0, 2])
    )
    cosine = min(max(determinant / (2.0 * scale**3), -1.0), 1.0)
    return mean + 2.0 * scale * math.cos((math.acos(cosine) + math.tau) / 3.0)


@kernel("float64[:, :](float64[:, :, :])")
def _least_directions(matrices):
    """Unit eigenvector of the smallest eigenvalue of each symmetric matrix, with any sign; zero if it is not unique.

    It is perpendicular to all rows of A - lambda I, and computed as the longest cross product of two of them.
    """
    directions = np.zeros((len(matrices), 3))
    for index in range(len(matrices)):
        a = matrices[index]
        least = _least_eigenvalue(a)
        longest = 0.0
        for i in range(3):
            j = (i + 1) % 3
            p, q = a[i].copy(), a[j].copy()
            p[i] -= least
            q[j] -= least
            x, y, z = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
            length = math.sqrt(x * x + y * y + z * z)
            if length > longest:
                longest = length
                directions[index, 0], directions[index, 1], directions[index, 2] = x / length, y / length, z / length
    return directions
