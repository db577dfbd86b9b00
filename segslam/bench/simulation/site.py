"""The site along a drive: the driven road with times, the sides of its streets, occupied cells, and paved areas."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from segslam.bench.simulation.mesh import Mesh, placed
from segslam.bench.simulation.terrain import CELL_M, Terrain, middle_of_street
from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Label, Points, Vector

BEYOND_M = 60.0  # chosen: length of street added before the start and after the end of the drive
APART_M = 15.0  # chosen: the added street ends where it comes this near to another part of the drive
PASS_M = 12.0  # chosen: a place is visited when the sensor is this near
VISIT_GAP_S = 5.0  # chosen: least time between two visits
STREET_GAP_M = 7.0  # chosen: a path nearer than this to an earlier part of itself is on the same street
REACH_M = 15.0  # chosen: a free place is searched for this far beyond the requested distance


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """The road under a drive, one row per pose: position (m), time (s) and horizontal travel (m)."""

    at: Points
    time_s: Vector
    travel_m: Vector


def street_of(route: Route, T_world_lidar: Poses) -> Points:
    """(n, 3) the route at steps of at most 1 m, with the street extended straight at both ends."""
    length = route.travel_m[-1]
    stations = np.linspace(0.0, length, int(np.ceil(length)) + 1)
    moving = np.concatenate([[True], np.diff(route.travel_m) > 1e-6])
    driven = np.column_stack([np.interp(stations, route.travel_m[moving], route.at[moving, axis]) for axis in range(3)])
    before = _straight_on(driven, route.at[0], -T_world_lidar[0, :2, 0])
    after = _straight_on(driven, route.at[-1], T_world_lidar[-1, :2, 0])
    return np.concatenate([before[::-1], driven, after])


def _straight_on(driven: Points, end: np.ndarray, heading: np.ndarray) -> Points:
    """Points 1 m apart that extend one end at constant height, up to the next other part of the drive."""
    reach = np.arange(1.0, BEYOND_M + 1.0)[:, None]
    points = end + np.hstack([reach * heading / np.linalg.norm(heading), np.zeros_like(reach)])
    elsewhere = driven[np.linalg.norm(driven[:, :2] - end[:2], axis=1) > APART_M]
    if len(elsewhere) == 0:
        return points
    distance, _ = cKDTree(elsewhere[:, :2]).query(points[:, :2])
    met = np.flatnonzero(distance < APART_M)
    return points[: met[0]] if len(met) else points


def time_between_visits(route: Route, x: float, y: float, rng: np.random.Generator) -> float | None:
    """A random time (s) between two consecutive visits of a place; None if there are fewer than two visits."""
    near = np.linalg.norm(route.at[:, :2] - [x, y], axis=1) < PASS_M
    moments = route.time_s[near]
    gaps = np.flatnonzero(np.diff(moments) > VISIT_GAP_S)
    if len(gaps) == 0:
        return None
    gap = rng.choice(gaps)
    return float(rng.uniform(moments[gap], moments[gap + 1]))


@dataclass(frozen=True, slots=True, eq=False)
class Frontage:
    """One side of the streets, as points 1 m apart: `at` (n, 2) on the centre line, `outward` (n, 2) unit vectors."""

    at: np.ndarray
    outward: np.ndarray
    heading_rad: Vector
    """Heading of the street, with this side on its left."""


@dataclass(frozen=True, slots=True)
class Spot:
    """A place for an object: its position, and the heading of the street beside it."""

    x: float
    y: float
    heading_rad: float


def frontages(path: np.ndarray) -> tuple[Frontage, Frontage]:
    """Left and right side of the streets along a path (n, 3) with points 1 m apart; each street occurs once."""
    middle = middle_of_street(path)
    normal = geometry.unit_rows(middle - path[:, :2])
    pairs = cKDTree(middle).query_pairs(STREET_GAP_M, output_type="ndarray").reshape(-1, 2)
    again = pairs[pairs[:, 1] - pairs[:, 0] > 4 * STREET_GAP_M, 1]
    first = np.setdiff1d(np.arange(len(middle)), again)
    heading = np.arctan2(-normal[:, 0], normal[:, 1])
    left = Frontage(middle[first], normal[first], heading[first])
    return left, Frontage(middle[first], -normal[first], heading[first] + np.pi)


class Site:
    """The ground, and the cells on which objects stand."""

    def __init__(self, ground: Terrain) -> None:
        self.ground = ground
        self._taken = np.zeros(ground.height_m.shape, dtype=bool)

    def claim(self, spot: Spot, length_m: float, width_m: float, *, clearance_m: float) -> bool:
        """Occupy a rectangle; False if part of it is occupied, or nearer than the clearance to the driven path."""
        row, column = self._cells(spot, length_m, width_m)
        if self.ground.path_m[row, column].min() < clearance_m or self._taken[row, column].any():
            return False
        self._taken[row, column] = True
        return True

    def pave(self, spot: Spot, length_m: float, width_m: float, label: Label) -> None:
        """Change the class of the terrain in a rectangle; roads and sidewalks are unchanged."""
        row, column = self._cells(spot, length_m, width_m)
        soft = self.ground.labels[row, column] == Label.TERRAIN
        self.ground.labels[row[soft], column[soft]] = label

    def outward(self, frontage: Frontage, station: int, distance_m: float) -> Spot:
        """The first spot outward from a station that is `distance_m` away from the centre line of every street."""
        reach = distance_m + np.arange(0.0, REACH_M, CELL_M / 2)
        x, y = (frontage.at[station] + reach[:, None] * frontage.outward[station]).T
        row, column = self.ground.cells(x, y)
        step = int(np.argmax(self.ground.street_m[row, column] >= distance_m - CELL_M / 2))
        return Spot(float(x[step]), float(y[step]), float(frontage.heading_rad[station]))

    def stand(self, thing: Mesh, spot: Spot, *, turn_rad: float = 0.0) -> Mesh:
        """The object placed on the ground of a spot, with its x axis along the street, rotated by `turn_rad`."""
        z = float(self.ground.height_at(np.array([spot.x]), np.array([spot.y]))[0])
        return placed(thing, spot.x, spot.y, z, yaw_rad=spot.heading_rad + turn_rad)

    def _cells(self, spot: Spot, length_m: float, width_m: float) -> np.ndarray:
        """(2, n) rows and columns of a rectangle centred on a spot, `length_m` along the street."""
        along, across = (  # less than one cell apart
            np.linspace(-size_m / 2, size_m / 2, int(size_m / CELL_M * 1.3) + 2) for size_m in (length_m, width_m)
        )
        u, v = (grid.ravel() for grid in np.meshgrid(along, across))
        c, s = np.cos(spot.heading_rad), np.sin(spot.heading_rad)
        return self.ground.cells(spot.x + c * u - s * v, spot.y + s * u + c * v)


def displaced(spot: Spot, *, along_m: float = 0.0, out_m: float = 0.0) -> Spot:
    """A spot displaced along the street and away from it."""
    c, s = np.cos(spot.heading_rad), np.sin(spot.heading_rad)
    return Spot(spot.x + c * along_m - s * out_m, spot.y + s * along_m + c * out_m, spot.heading_rad)
