"""Is an alignment to be believed? Overlap of the surfaces, their distance, and the space that either scan saw empty.

Of two scans aligned as they should be, what stands in one lies in the surfaces of the other, and neither has a point
where the other looked through: a ray that returned from 30 m says that nothing stands at 20 m on its way. The ground
says nothing: it lies in the ground of any other street as well.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

from segslam import geometry
from segslam.config import VerifyConfig
from segslam.points import within_range
from segslam.types import Points, Rejected, RejectReason, Transform

NUM_COLUMNS = 360
NUM_ROWS = 60
LOWEST_RAD = math.radians(-30.0)
HIGHEST_RAD = math.radians(30.0)
"""A cell is one degree wide and high: of 64 beams some two cross it, of 16 every second row has one."""
MIN_RANGE_M = 3.0
"""Nearer points are often the vehicle itself."""


class Surface(Protocol):
    """What refinement prepared of a scan."""

    @property
    def points(self) -> Points:
        """(n, 3) m, in the scan's frame."""
        ...

    @property
    def standing(self) -> Points:
        """Those above the ground."""
        ...

    def distances_m(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each, of some points in its frame: to the nearest point of the surface, and to the plane there (m)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a sensor saw: for each direction with a return, the nearest there or in the eight cells around it.

    (NUM_ROWS, NUM_COLUMNS) float32 in metres; infinite where nothing returned. That says nothing, whatever its
    neighbours saw: where grazing rays on the ground are lost, those above go on to the wall behind.
    """

    nearest_m: np.ndarray


@dataclass(frozen=True, slots=True)
class Agreement:
    """How two aligned scans agree; of the two ways to look at it, the worse."""

    overlap: float
    """Share of the standing points within reach of the other scan that lie within `inlier_m` of it."""
    rms_m: float
    """Of those points, to the plane of the other surface."""
    free_space_violation: float
    """Share of the points, where the other scan has a return, that stand well before it."""


def view(points: Points) -> View:
    """The view of a scan from its own sensor's place; `points` (n, 3) in the sensor's frame."""
    nearest = _nearest_returns(np.ascontiguousarray(points, np.float32))
    padded = np.pad(nearest, ((1, 1), (0, 0)), constant_values=np.inf)
    padded = np.pad(padded, ((0, 0), (1, 1)), mode="wrap")
    across = np.minimum(np.minimum(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:])
    around = np.minimum(np.minimum(across[:-2], across[1:-1]), across[2:])
    return View(np.where(np.isfinite(nearest), around, np.float32(np.inf)))


def agreement(
    source: tuple[Surface, View], target: tuple[Surface, View], T_target_source: Transform, *, config: VerifyConfig
) -> Agreement:
    """How well the two scans agree under this pose of the source in the target."""
    ways = [
        (*_surface_agreement(a[0], b[0], T_b_a, config), free_space_violation(a[0].points, b[1], T_b_a, config=config))
        for a, b, T_b_a in (
            (source, target, T_target_source),
            (target, source, geometry.inverse(T_target_source)),
        )
    ]
    overlaps, residuals, violations = zip(*ways, strict=True)
    return Agreement(min(overlaps), max(residuals), max(violations))


def free_space_violation(points: Points, seen: View, T_view_points: Transform, *, config: VerifyConfig) -> float:
    """Share, 0 to 1, of the points that stand before all that the view saw around their direction.

    Only directions with a return count; 0 where there is none.
    """
    moved = geometry.apply(T_view_points, points).astype(np.float32)
    margins = np.array([config.free_space_margin_m, config.free_space_margin_ratio])
    num_violations, num_seen = _count_violations(moved, seen.nearest_m, margins)
    return num_violations / num_seen if num_seen else 0.0


def early_rejection(
    source: tuple[Surface, View], target: tuple[Surface, View], T_target_source: Transform, *, config: VerifyConfig
) -> Rejected | None:
    """Rejects a coarse pose that violates thrice the free space allowed: refinement hardly mends that. Takes 1 ms."""
    forth = free_space_violation(source[0].points, target[1], T_target_source, config=config)
    back = free_space_violation(target[0].points, source[1], geometry.inverse(T_target_source), config=config)
    allowed = 3 * config.max_free_space_violation
    if max(forth, back) > allowed:
        return Rejected(RejectReason.FREE_SPACE_VIOLATED, f"{max(forth, back):.4f} > {allowed} before refinement")
    return None


def rejection(found: Agreement, *, config: VerifyConfig) -> Rejected | None:
    """The first test that an alignment fails, in the order of the pipeline; None if it stands."""
    if found.overlap < config.min_overlap:
        return Rejected(RejectReason.LOW_OVERLAP, f"{found.overlap:.3f} < {config.min_overlap}")
    if found.rms_m > config.max_rms_m:
        return Rejected(RejectReason.HIGH_RESIDUAL, f"{found.rms_m:.3f} m > {config.max_rms_m} m")
    if found.free_space_violation > config.max_free_space_violation:
        detail = f"{found.free_space_violation:.4f} > {config.max_free_space_violation}"
        return Rejected(RejectReason.FREE_SPACE_VIOLATED, detail)
    return None


def _surface_agreement(a: Surface, b: Surface, T_b_a: Transform, config: VerifyConfig) -> tuple[float, float]:
    """Overlap and residual of a's standing points within reach of b's sensor; no overlap where none is."""
    moved = geometry.apply(T_b_a, a.standing)
    moved = moved[within_range(moved, 0.0, config.max_range_m)]
    if not len(moved):
        return 0.0, math.inf
    to_point, to_plane = b.distances_m(moved)
    met = to_plane[to_point < config.inlier_m]
    return len(met) / len(moved), float(np.sqrt(np.mean(met**2))) if len(met) else math.inf


@njit("UniTuple(int64, 2)(float32, float32, float32)", cache=True)
def _cell(x, y, z):
    """Row and column of a direction; the row may lie outside the view."""
    elevation = math.atan2(z, math.sqrt(x * x + y * y))
    row = math.floor((elevation - LOWEST_RAD) / (HIGHEST_RAD - LOWEST_RAD) * NUM_ROWS)
    column = math.floor((math.atan2(y, x) + math.pi) / (2.0 * math.pi) * NUM_COLUMNS)
    return int(row), int(column) % NUM_COLUMNS


@njit("float32[:, :](float32[:, ::1])", cache=True, nogil=True)
def _nearest_returns(points):
    nearest = np.full((NUM_ROWS, NUM_COLUMNS), np.inf, np.float32)
    for at in range(len(points)):
        x, y, z = points[at, 0], points[at, 1], points[at, 2]
        distance = math.sqrt(x * x + y * y + z * z)
        if MIN_RANGE_M < distance < np.inf:  # false for NaN
            row, column = _cell(x, y, z)
            if 0 <= row < NUM_ROWS:
                nearest[row, column] = min(nearest[row, column], distance)
    return nearest


@njit("UniTuple(int64, 2)(float32[:, :], float32[:, :], float64[:])", cache=True, nogil=True)
def _count_violations(points, nearest, margins):
    """Of the points whose direction has a return, those that stand before it by `margins` (m, and per metre); all."""
    num_violations = num_seen = 0
    for x, y, z in points:
        row, column = _cell(x, y, z)
        distance = math.sqrt(x * x + y * y + z * z)
        if 0 <= row < NUM_ROWS and distance > MIN_RANGE_M and nearest[row, column] < np.inf:
            num_seen += 1
            if distance + margins[0] + margins[1] * distance < nearest[row, column]:
                num_violations += 1
    return num_violations, num_seen
