"""The building site along a drive: occupied cells, paved areas, and the sides of the streets."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from segslam.bench.simulation.mesh import Mesh, placed
from segslam.bench.simulation.terrain import CELL_M, Terrain, middle_of_street
from segslam.core.types import Label, Vector

STREET_GAP_M = 7.0  # chosen: a path nearer than this to an earlier part of itself is on the same street
REACH_M = 15.0  # chosen: a free place is searched for this far beyond the requested distance


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
    normal = middle - path[:, :2]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
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
        along, across = (_samples(size) for size in (length_m, width_m))
        u, v = (grid.ravel() for grid in np.meshgrid(along, across))
        c, s = np.cos(spot.heading_rad), np.sin(spot.heading_rad)
        return self.ground.cells(spot.x + c * u - s * v, spot.y + s * u + c * v)


def _samples(size_m: float) -> Vector:
    """Positions from one end to the other, less than one cell apart."""
    return np.linspace(-size_m / 2, size_m / 2, int(size_m / CELL_M * 1.3) + 2)


def displaced(spot: Spot, *, along_m: float = 0.0, out_m: float = 0.0) -> Spot:
    """A spot displaced along the street and away from it."""
    c, s = np.cos(spot.heading_rad), np.sin(spot.heading_rad)
    return Spot(spot.x + c * along_m - s * out_m, spot.y + s * along_m + c * out_m, spot.heading_rad)
