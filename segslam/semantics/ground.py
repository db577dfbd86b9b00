"""The ground of one scan: which way is up, and how high each point stands above it.

The surface under the sensor is followed outwards cell by cell: each cell looks for its lowest points near the height
that its neighbours nearer to the sensor expect, so that other levels, roofs and reflections below the road are
passed by.
"""

import numpy as np
from numba import njit

from segslam.types import Points, Rotation, Vector

MAX_TILT_DEG = 40.0
"""Chosen: a sensor in the hand leans up to 33 degrees in the recordings at hand."""
LEVEL_RADIUS_M = 15.0
"""Chosen: the ground this near decides which way is up."""


def upright(points: Points) -> Rotation:
    """R_level_lidar: the turn that makes the widest nearly horizontal surface below the sensor level.

    Searches tilts up to 40 degrees. The identity where fewer than 10 square metres are seen below the sensor.
    """
    lowest = _lowest_of_cells(points.astype(np.float64), LEVEL_RADIUS_M)
    if len(lowest) < 10:
        return np.eye(3)
    normals = _upward_normals()
    heights = lowest @ normals.T
    bins = np.floor(heights / 0.2).astype(np.int64)
    bins[bins >= 0] = -1  # the bin that touches the sensor also takes what cannot be ground
    bins = np.clip(bins, -64, -1) + 64
    votes = np.apply_along_axis(np.bincount, 0, bins, minlength=64)
    votes[63] = 0
    best = int(np.argmax(votes.max(axis=0)))
    normal, offset = normals[best], (int(np.argmax(votes[:, best])) - 63.5) * 0.2
    for bound_m in (0.4, 0.2, 0.15):
        near = lowest[np.abs(lowest @ normal - offset) < bound_m]
        if len(near) < 10:
            return np.eye(3)
        normal, offset = _plane(near)
    return _turn_to_z(normal) if normal[2] > np.cos(np.radians(MAX_TILT_DEG)) else np.eye(3)


@njit(cache=True, nogil=True)
def _lowest_of_cells(points, radius_m):
    """The lowest point of each square metre within a radius of the sensor; of equals the first by x, then y."""
    half = int(np.ceil(radius_m))
    lowest = np.full((4 * half * half, 3), np.inf)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if x * x + y * y >= radius_m * radius_m:
            continue
        cell = int(np.floor(x) + half) * 2 * half + int(np.floor(y) + half)
        best = lowest[cell]
        if z < best[2] or (z == best[2] and (x < best[0] or (x == best[0] and y < best[1]))):
            best[0], best[1], best[2] = x, y, z
    return lowest[np.isfinite(lowest[:, 2])]


def _upward_normals() -> Points:
    """Unit vectors within MAX_TILT_DEG of z, some 4 degrees apart, the least tilted first."""
    normals = [(0.0, 0.0, 1.0)]
    for tilt in np.radians(np.arange(4.0, MAX_TILT_DEG, 4.0)):
        around = np.arange(0.0, 2 * np.pi, np.radians(4.0) / np.sin(tilt))
        normals += [(np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)) for a in around]
    return np.array(normals)


def _plane(points: Points) -> tuple[np.ndarray, float]:
    """Upward unit normal and height along it of the plane through points, by least squares."""
    mean = points.mean(axis=0)
    normal = np.linalg.eigh(np.cov(points.T))[1][:, 0]
    normal *= np.sign(normal[2]) or 1.0
    return normal, float(mean @ normal)


def _turn_to_z(normal: np.ndarray) -> Rotation:
    """The smallest rotation that takes a unit vector to z."""
    x, y, z = normal
    k = 1.0 / (1.0 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def heights_above_ground(points: Points, *, cell_m: float, max_range_m: float, max_slope: float) -> Vector:
    """Height of each point above the ground below it (m), for points in a level frame, the sensor at the origin.

    Points farther than `max_range_m` (in x or y) are measured from the nearest cell of the border.
    """
    half = int(np.ceil(max_range_m / cell_m))
    cells = np.clip(np.floor(points[:, :2] / cell_m).astype(np.int64) + half, 0, 2 * half - 1)
    flat = cells[:, 0] * (2 * half) + cells[:, 1]
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(4 * half * half + 1))
    surface = _follow(points[order, 2].astype(np.float64), starts, _outward(half), half, cell_m, max_slope)
    return points[:, 2] - _interpolate(points.astype(np.float64), surface, half, cell_m)


def _outward(half: int) -> np.ndarray:
    """Cells of the grid by distance from the sensor, nearest first."""
    centre = np.arange(2 * half) - half + 0.5
    return np.argsort((centre[:, None] ** 2 + centre**2).ravel(), kind="stable")


@njit(cache=True, nogil=True)
def _follow(z, starts, outward, half, cell_m, max_slope):
    """Ground height of each cell, (2 half, 2 half)."""
    side = 2 * half
    height = np.full((side, side), np.nan)
    gap = np.zeros((side, side))  # cells since ground was last seen on the way here
    z0 = _start_height(z, starts, half, cell_m)
    for flat in outward:
        i, j = flat // side, flat % side
        radius = (i - half + 0.5) ** 2 + (j - half + 0.5) ** 2
        total = 0.0
        weight = 0.0
        nearest_gap = 1e9
        for a in range(max(i - 1, 0), min(i + 2, side)):
            for b in range(max(j - 1, 0), min(j + 2, side)):
                if np.isnan(height[a, b]) or (a - half + 0.5) ** 2 + (b - half + 0.5) ** 2 >= radius:
                    continue
                w = 1.0 / (1.0 + gap[a, b]) ** 2
                total += w * height[a, b]
                weight += w
                nearest_gap = min(nearest_gap, gap[a, b])
        expected = total / weight if weight > 0 else z0
        reach = nearest_gap if weight > 0 else 2.0
        tolerance = min(0.1 + max_slope * cell_m * (1.0 + reach), 1.0)
        found = _lowest_surface(z[starts[flat] : starts[flat + 1]], expected - tolerance - 0.1, expected + tolerance)
        if np.isnan(found):
            height[i, j] = expected
            gap[i, j] = reach + 1.0
        else:
            height[i, j] = found
    return height


@njit(cache=True, nogil=True)
def _start_height(z, starts, half, cell_m):
    """Height of the ground at the sensor: the 10th percentile of what lies below it within 8 m."""
    reach = min(int(8.0 / cell_m), half)
    below = np.empty(len(z))
    count = 0
    for i in range(half - reach, half + reach):
        row = i * 2 * half + half
        for value in z[starts[row - reach] : starts[row + reach]]:
            if value < -0.3:
                below[count] = value
                count += 1
    return np.percentile(below[:count], 10) if count > 0 else -1.7


@njit(cache=True, nogil=True)
def _lowest_surface(z, low, high):
    """Mean height of the lowest 0.15 m that are occupied between two bounds; NaN where nothing is."""
    lowest = np.inf
    for value in z:
        if low < value < high:
            lowest = min(lowest, value)
    total = 0.0
    count = 0
    for value in z:
        if lowest <= value < min(lowest + 0.15, high):
            total += value
            count += 1
    return total / count if count > 0 else np.nan


@njit(cache=True, nogil=True)
def _interpolate(points, surface, half, cell_m):
    """Bilinear height of the surface below each point."""
    heights = np.empty(len(points))
    last = 2 * half - 1
    for k in range(len(points)):
        x = min(max(points[k, 0] / cell_m + half - 0.5, 0.0), float(last))
        y = min(max(points[k, 1] / cell_m + half - 0.5, 0.0), float(last))
        i, j = min(int(x), last - 1), min(int(y), last - 1)
        u, v = x - i, y - j
        below = surface[i, j] * (1 - v) + surface[i, j + 1] * v
        above = surface[i + 1, j] * (1 - v) + surface[i + 1, j + 1] * v
        heights[k] = below * (1 - u) + above * u
    return heights
