"""The ground along a drive: a smooth road through the driven path, kerbs, and terrain beyond."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from segslam.bench.simulation.mesh import Mesh, mesh
from segslam.core import geometry
from segslam.core.types import Label, Labels, Vector

CELL_M = 0.5  # chosen: width of a kerb
COARSE = 4  # cells along the side of a triangle away from the road
MARGIN_M = 85.0  # chosen: slightly beyond the range from which most points return
LANE_M = 1.2  # chosen: offset of the sensor to the right of the street's centre line
ROAD_M, SIDEWALK_M = 5.4, 7.4  # chosen: half width of the road; distance from its centre line to the gardens
KERB_M = 0.12
FINE_M = 9.0  # chosen: triangles nearer than this to the path are small
SCALES_M = (64.0, 32.0, 16.0, 8.0, 4.0, 2.0)  # chosen: from the shape of the terrain to the road under half a car

Raster = Float[np.ndarray, "_ _"]


class Terrain:
    """Ground along a path: rasters with cells of CELL_M over x (rows) and y (columns), starting at `origin`."""

    def __init__(self, path: np.ndarray, rng: np.random.Generator) -> None:
        """The road goes through `path` (n, 3), whose points are at most 1 m apart."""
        self.origin = np.floor(path[:, :2].min(axis=0) - MARGIN_M)
        span = np.ceil(path[:, :2].max(axis=0) + MARGIN_M) - self.origin
        blocks = [int(blocks) for blocks in np.ceil(span / (CELL_M * COARSE))]
        at = path[:, :2] - self.origin
        self.path_m = _distance_m(at / CELL_M, (blocks[0] * COARSE + 1, blocks[1] * COARSE + 1))
        """Distance to the nearest point of the driven path."""
        self.street_m = _distance_m((middle_of_street(path) - self.origin) / CELL_M, self.path_m.shape)
        """Distance to the centre line of the nearest street."""
        coarse = _through(path[:, 2], at / (CELL_M * COARSE), (blocks[0] + 1, blocks[1] + 1))
        coarse += _relief(rng, self.street_m[::COARSE, ::COARSE])
        along = [np.linspace(0, size - 1, (size - 1) * COARSE + 1) for size in coarse.shape]
        fine = map_coordinates(coarse, np.stack(np.meshgrid(*along, indexing="ij")), order=1)
        self.height_m = fine + np.clip((self.street_m - ROAD_M) / CELL_M, 0.0, 1.0) * KERB_M
        kinds = [self.street_m < ROAD_M, self.street_m < SIDEWALK_M]
        self.labels = np.select(kinds, [Label.ROAD, Label.SIDEWALK], Label.TERRAIN).astype(np.uint8)

    def cells(self, x: Vector, y: Vector) -> np.ndarray:
        """(2, n) row and column of the nearest node, clipped to the raster."""
        nearest = np.rint(np.stack([x - self.origin[0], y - self.origin[1]]) / CELL_M).astype(np.int64)
        return np.clip(nearest, 0, np.array(self.height_m.shape)[:, None] - 1)

    def label_at(self, x: Vector, y: Vector) -> Labels:
        """(n,) class of the ground at positions (m)."""
        row, column = self.cells(x, y)
        return self.labels[row, column]

    def height_at(self, x: Vector, y: Vector) -> Vector:
        """(n,) height (m), interpolated between the nodes."""
        at = np.stack([x - self.origin[0], y - self.origin[1]]) / CELL_M
        return map_coordinates(self.height_m, at, order=1, mode="nearest")


def middle_of_street(path: np.ndarray) -> np.ndarray:
    """(n, 2) centre line of the street beside a path (n, 2 or 3) with points at most 1 m apart."""
    tangent = geometry.unit_rows(np.gradient(path[:, :2], axis=0))
    return path[:, :2] + LANE_M * np.column_stack([-tangent[:, 1], tangent[:, 0]])


def _distance_m(at: np.ndarray, shape: tuple[int, ...]) -> Raster:
    """Distance of each node to the nearest of the fractional nodes `at`, accurate to about CELL_M / 3."""
    row, column = np.rint(at).astype(int).T
    away = np.ones(shape, dtype=bool)
    away[row, column] = False
    return distance_transform_edt(away) * CELL_M


def _through(heights: Vector, at: np.ndarray, shape: tuple[int, ...]) -> Raster:
    """A smooth surface through the heights at nodes `at`; each scale corrects the previous one."""
    row, column = np.rint(at).astype(int).T
    weight = np.zeros(shape)
    np.add.at(weight, (row, column), 1.0)
    surface = np.full(shape, heights.mean())
    for scale in SCALES_M:
        residual = np.zeros(shape)
        np.add.at(residual, (row, column), heights - map_coordinates(surface, at.T, order=1))
        sigma = scale / (CELL_M * COARSE)
        spread = gaussian_filter(weight, sigma, truncate=3.0)
        surface += gaussian_filter(residual, sigma, truncate=3.0) / (spread + 0.02 / sigma)
    return surface


def _relief(rng: np.random.Generator, distance: Raster) -> Raster:
    """Bumps of lawns and gardens (m), zero on the road; one node every 2 m."""
    rough = gaussian_filter(rng.normal(size=distance.shape), 0.5) * 0.05
    rolling = gaussian_filter(rng.normal(size=distance.shape), 5.0) * 4.0
    return (rough + rolling) * np.clip((distance - SIDEWALK_M) / 10.0, 0.0, 1.0)


def ground_mesh(ground: Terrain) -> Mesh:
    """Triangles of CELL_M near the road and of COARSE cells elsewhere, within MARGIN_M of the path.

    The boundary lies beyond the kerb, where fine nodes lie on the edges of coarse triangles: the mesh has no gaps.
    """
    corners = ground.street_m[::COARSE, ::COARSE]
    nearest = np.minimum.reduce([corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:]])
    fine = nearest < FINE_M
    near = np.kron(fine, np.ones((COARSE, COARSE), dtype=bool))
    blocks = np.argwhere(~fine & (nearest < MARGIN_M)) * COARSE
    triangles = np.concatenate([_cells(np.argwhere(near), 1), _cells(blocks, COARSE)])
    nodes, flat = np.unique(triangles @ [ground.height_m.shape[1], 1], return_inverse=True)
    row, column = np.divmod(nodes, ground.height_m.shape[1])
    xy = np.column_stack([row, column]) * CELL_M + ground.origin
    return mesh(np.column_stack([xy, ground.height_m[row, column]]), flat.reshape(-1, 3), Label.TERRAIN)


def _cells(corner: np.ndarray, size: int) -> np.ndarray:
    """(2 k, 3, 2) nodes of the two triangles of each cell; `corner` (k, 2): lowest row and column of the cell."""
    a, b, c, d = (corner + np.array(step) * size for step in ((0, 0), (1, 0), (1, 1), (0, 1)))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
