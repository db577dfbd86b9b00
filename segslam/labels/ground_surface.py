"""The ground of one scan: its vertical direction, and the height of each point above it.

The ground is traced outwards from below the sensor, cell by cell. The height of a cell is that of its lowest points
near the height predicted from the neighbours nearer to the sensor. Other storeys, roofs and reflections below the
road are thereby ignored.
"""

from functools import cache

import numpy as np

from segslam.core import geometry
from segslam.core.kernels import kernel
from segslam.core.types import Indices, Points, Rotation, Vector

MAX_TILT_DEG = 40.0
"""Chosen: the hand-held sensor of the courtyard recording is tilted by up to 33 degrees."""
LEVEL_RADIUS_M = 15.0
"""Chosen: the vertical direction is estimated from the ground within this radius."""
LEVEL_BIN_M = 0.2
"""Chosen: thickness of a layer whose points count for the same plane."""
MIN_LEVEL_CELLS = 10
GROUND_CELL_M = 1.0
"""Chosen: cell size of the ground surface (m)."""
MAX_SLOPE = 0.2
"""Chosen: largest slope of the ground between cells."""
SURFACE_M = 0.15
"""Chosen: the height of a cell is the mean of its lowest points within this height."""


def upright(points: Points) -> Rotation:
    """R_level_lidar: the smallest rotation that makes the largest nearly horizontal surface below the sensor level.

    The points (n, 3) must be finite. Tilts up to 40 degrees are searched. Returns the identity if less than 10 square
    metres of such a surface are visible.
    """
    lowest = _lowest_of_cells(points, LEVEL_RADIUS_M)
    if len(lowest) < MIN_LEVEL_CELLS:
        return np.eye(3)
    normals = _upward_normals()
    votes = _votes(lowest, normals, int(LEVEL_RADIUS_M / LEVEL_BIN_M))
    best, depth = np.unravel_index(int(np.argmax(votes)), votes.shape)
    normal, height = normals[best], -(float(depth) + 0.5) * LEVEL_BIN_M
    for bound_m in (0.4, 0.2, 0.15):
        near = lowest[np.abs(_along(lowest, normal) - height) < bound_m]
        if len(near) < MIN_LEVEL_CELLS:
            return np.eye(3)
        mean = near.mean(axis=0)
        normal = np.linalg.eigh(np.cov(near.T))[1][:, 0]  # of the least-squares plane
        normal = normal if normal[2] > 0 else -normal
        height = float(mean @ normal)
    return geometry.level(normal) if normal[2] > np.cos(np.radians(MAX_TILT_DEG)) else np.eye(3)


def rotated(points: Points, R_a_b: Rotation) -> Points:
    """Points of frame b in frame a, float64. Unlike with a matrix product, equal rows give exactly equal results."""
    return np.column_stack([_along(points, row) for row in R_a_b])


def heights_above_ground(points: Points, *, max_range_m: float) -> Vector:
    """Height (n,) of each point above the ground (m), for points in a level frame with the sensor at the origin.

    Points farther than `max_range_m` in x or y use the nearest cell of the border. Cells without visible ground
    take the height of their neighbours nearer to the sensor.
    """
    half = int(np.ceil(max_range_m / GROUND_CELL_M))
    cells = np.clip(np.floor(points[:, :2] / GROUND_CELL_M).astype(np.int64) + half, 0, 2 * half - 1)
    cell = cells[:, 0] * 2 * half + cells[:, 1]
    starts = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=4 * half * half))])
    x, y, z = points.T
    # The ground at the sensor is the 10th percentile of the points below it within 8 m.
    below = z[(x >= -8.0) & (x < 8.0) & (y >= -8.0) & (y < 8.0) & (z < -0.3)]
    at_sensor = float(np.percentile(below, 10)) if len(below) else -1.7
    surface = _follow(z[np.argsort(cell, kind="stable")], starts, _outward(half), at_sensor, half)
    return points[:, 2] - _interpolate(points, surface, half)


def _along(points: Points, direction: np.ndarray) -> Vector:
    x, y, z = direction
    return points[:, 0] * x + points[:, 1] * y + points[:, 2] * z


@kernel("float64[:, :](float64[:, ::1], float64)")
def _lowest_of_cells(points, radius_m):
    """The lowest point of each square metre within a radius of the sensor; ties are resolved by x, then y."""
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


@kernel("int64[:, ::1](float64[:, :], float64[:, ::1], int64)")
def _votes(points, normals, num_bins):
    """Number of points in each bin of depth below the sensor, for each normal. Bins above the sensor stay empty."""
    votes = np.zeros((len(normals), num_bins), np.int64)
    for n in range(len(normals)):
        x, y, z = normals[n]
        for k in range(len(points)):
            depth = -(points[k, 0] * x + points[k, 1] * y + points[k, 2] * z) / LEVEL_BIN_M
            if 1.0 <= depth < num_bins:
                votes[n, int(depth)] += 1
    return votes


@cache
def _upward_normals() -> Points:
    """Unit vectors within MAX_TILT_DEG of z, about 4 degrees apart, in the order of their tilt."""
    step = np.radians(4.0)
    normals = [(0.0, 0.0, 1.0)]
    for tilt in np.arange(step, np.radians(MAX_TILT_DEG) + step / 2, step):
        around = np.arange(0.0, 2 * np.pi, step / np.sin(tilt))
        normals += [(np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)) for a in around]
    return np.array(normals)


@cache
def _outward(half: int) -> Indices:
    """Cells of the grid by distance from the sensor, nearest first."""
    squared = (2 * np.arange(-half, half) + 1) ** 2
    return np.argsort((squared[:, None] + squared).ravel(), kind="stable")


@kernel("float64[:, ::1](float64[::1], int64[::1], int64[::1], float64, int64)")
def _follow(z, starts, outward, height_below_sensor, half):
    """Ground height of each cell, (2 half, 2 half)."""
    side = 2 * half
    height = np.full((side, side), np.nan)
    gap = np.zeros((side, side))  # cells since ground was last observed on the way here
    for flat in outward:
        i, j = flat // side, flat % side
        expected, reach = _expected(height, gap, i, j, half)
        if np.isnan(expected):
            expected = height_below_sensor
        tolerance = min(0.1 + MAX_SLOPE * GROUND_CELL_M * (1.0 + reach), 1.0)
        found = _lowest_surface(z[starts[flat] : starts[flat + 1]], expected - tolerance - 0.1, expected + tolerance)
        if np.isnan(found):
            height[i, j] = expected
            gap[i, j] = reach + 1.0
        else:
            height[i, j] = found
    return height


@kernel("UniTuple(float64, 2)(float64[:, ::1], float64[:, ::1], int64, int64, int64)")
def _expected(height, gap, i, j, half):
    """Mean height of the neighbours nearer to the sensor, preferably observed ones, and the smallest of their gaps."""
    side = 2 * half
    distance = (2 * (i - half) + 1) ** 2 + (2 * (j - half) + 1) ** 2
    total, weight, least_gap = 0.0, 0.0, np.inf
    for a in range(max(i - 1, 0), min(i + 2, side)):
        for b in range(max(j - 1, 0), min(j + 2, side)):
            if (2 * (a - half) + 1) ** 2 + (2 * (b - half) + 1) ** 2 < distance:
                w = 1.0 / (1.0 + gap[a, b]) ** 2
                total += w * height[a, b]
                weight += w
                least_gap = min(least_gap, gap[a, b])
    if weight == 0.0:
        return np.nan, 2.0
    return total / weight, least_gap


@kernel("float64(float64[::1], float64, float64)")
def _lowest_surface(z, low, high):
    """Mean height of the lowest occupied SURFACE_M between two bounds; NaN if there are no points."""
    lowest = np.inf
    for value in z:
        if low < value < high:
            lowest = min(lowest, value)
    total_um, count = 0, 0  # integer micrometres: the sum does not depend on the order of the points
    for value in z:
        if lowest <= value < min(lowest + SURFACE_M, high):
            total_um += round(value * 1e6)
            count += 1
    return total_um / count / 1e6 if count > 0 else np.nan


@kernel("float64[::1](float64[:, ::1], float64[:, ::1], int64)")
def _interpolate(points, surface, half):
    """Height of the surface below each point, bilinear."""
    heights = np.empty(len(points))
    last = 2 * half - 1
    for k in range(len(points)):
        x = min(max(points[k, 0] / GROUND_CELL_M + half - 0.5, 0.0), float(last))
        y = min(max(points[k, 1] / GROUND_CELL_M + half - 0.5, 0.0), float(last))
        i, j = min(int(x), last - 1), min(int(y), last - 1)
        u, v = x - i, y - j
        below = surface[i, j] * (1 - v) + surface[i, j + 1] * v
        above = surface[i + 1, j] * (1 - v) + surface[i + 1, j + 1] * v
        heights[k] = below * (1 - u) + above * u
    return heights
