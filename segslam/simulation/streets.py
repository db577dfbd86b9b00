"""Where things stand along the driven streets: none on any piece of the path, none within another."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from segslam.simulation import buildings, plants
from segslam.simulation.ground import CELL_M, SIDEWALK_M, Ground
from segslam.simulation.mesh import Mesh, placed
from segslam.simulation.settings import WorldConfig
from segslam.types import Vector

STREET_GAP_M = 7.0  # chosen: a path this near to an earlier piece of itself is the same street
CAR_M, LAMP_M, SIGN_M, TREE_M, FRONT_M = 4.7, 6.1, 6.4, 7.0, 8.6  # chosen: from the path to the middle of each thing


@dataclass(frozen=True, slots=True, eq=False)
class Frontage:
    """Points of one side of the streets, a metre apart: `at` (n, 2) on the path, `outward` (n, 2) away from it."""

    at: np.ndarray
    outward: np.ndarray
    heading_rad: Vector
    """Of the street, with the side that is built on its left."""


class Site:
    """The ground with what is already built on it."""

    def __init__(self, ground: Ground) -> None:
        self.ground = ground
        self._taken = np.zeros(ground.height_m.shape, dtype=bool)

    def claim(self, x: float, y: float, length: float, width: float, yaw_rad: float, *, clearance_m: float) -> bool:
        """Take a rectangle, unless a piece of it is taken or nearer than the clearance to the driven path."""
        along = np.arange(-length / 2, length / 2 + CELL_M, CELL_M).clip(max=length / 2)
        across = np.arange(-width / 2, width / 2 + CELL_M, CELL_M).clip(max=width / 2)
        u, v = (grid.ravel() for grid in np.meshgrid(along, across))
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        row, column = self.ground.cells(x + c * u - s * v, y + s * u + c * v)
        if self.ground.distance_m[row, column].min() < clearance_m or self._taken[row, column].any():
            return False
        self._taken[row, column] = True
        return True

    def outward(self, frontage: Frontage, station: int, distance_m: float) -> tuple[float, float]:
        """The first point outward from a station that is `distance_m` from all of the path."""
        reach = distance_m + np.arange(0.0, 15.0, CELL_M / 2)
        x, y = (frontage.at[station] + reach[:, None] * frontage.outward[station]).T
        step = int(np.argmax(self.ground.distance_at(x, y) >= distance_m - CELL_M / 2))
        return float(x[step]), float(y[step])


def frontages(path_xy: np.ndarray) -> tuple[Frontage, Frontage]:
    """Left and right of the streets, each street once; `path_xy` (n, 2) a metre apart."""
    tangent = np.gradient(path_xy, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    pairs = cKDTree(path_xy).query_pairs(STREET_GAP_M, output_type="ndarray").reshape(-1, 2)
    again = pairs[pairs[:, 1] - pairs[:, 0] > 4 * STREET_GAP_M, 1]
    first = np.setdiff1d(np.arange(len(path_xy)), again)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    heading = np.arctan2(tangent[:, 1], tangent[:, 0])
    left = Frontage(path_xy[first], normal[first], heading[first])
    return left, Frontage(path_xy[first], -normal[first], heading[first] + np.pi)


def furnish(site: Site, frontage: Frontage, config: WorldConfig, rng: np.random.Generator) -> Iterator[Mesh]:
    """Everything that stands on one side, in the world: houses first, then what finds room before them."""
    yield from _lots(site, frontage, config, rng)
    yield from _row(
        site,
        frontage,
        rng,
        config.trees,
        _tree_maker(config),
        TREE_M,
        (0.5, 0.5),
        jitter=0.0 if config.equal_tree_rows else 0.8,
    )
    yield from _row(site, frontage, rng, config.lamps, buildings.lamp, LAMP_M, (0.5, 0.5), jitter=0.3)
    yield from _row(site, frontage, rng, config.signs, buildings.sign, SIGN_M, (0.5, 0.5), jitter=0.9)
    yield from _row(site, frontage, rng, 2.0, buildings.clutter, SIDEWALK_M, (1.2, 1.2), jitter=0.9)


def _row(
    site: Site,
    frontage: Frontage,
    rng: np.random.Generator,
    per_100m: float,
    make: Callable[[np.random.Generator], Mesh],
    distance_m: float,
    size_m: tuple[float, float],
    *,
    jitter: float,
) -> Iterator[Mesh]:
    """Things at a mean spacing along the street, each moved by up to `jitter` spacings either way."""
    if per_100m <= 0:
        return
    spacing = 100.0 / per_100m
    for nominal in np.arange(spacing / 2, len(frontage.at), spacing):
        station = int(np.clip(nominal + rng.uniform(-jitter, jitter) * spacing, 0, len(frontage.at) - 1))
        x, y = site.outward(frontage, station, distance_m + rng.uniform(0.0, 1.0) * min(jitter, 0.5))
        heading = float(frontage.heading_rad[station])
        thing = make(rng)
        if site.claim(x, y, *size_m, heading, clearance_m=distance_m - 1.0):
            yield _stood(site, thing, x, y, heading + float(rng.normal(scale=0.05)))


def _tree_maker(config: WorldConfig) -> Callable[[np.random.Generator], Mesh]:
    def equal(_: np.random.Generator) -> Mesh:
        return plants.tree(np.random.default_rng(0), scale=0.5)

    return equal if config.equal_tree_rows else plants.tree


def _lots(site: Site, frontage: Frontage, config: WorldConfig, rng: np.random.Generator) -> Iterator[Mesh]:
    """Lot after lot of 9-24 m: a house or trees at the back, a hedge, a fence or nothing towards the street."""
    start = 0
    while start < len(frontage.at):
        width = int(rng.integers(9, 25))
        middle = min(start + width // 2, len(frontage.at) - 1)
        yield from _lot(site, frontage, middle, float(width), config, rng)
        start += width


def _lot(
    site: Site, frontage: Frontage, middle: int, width: float, config: WorldConfig, rng: np.random.Generator
) -> Iterator[Mesh]:
    heading = float(frontage.heading_rad[middle])
    if rng.uniform() < config.built:
        setback, depth, wide = rng.uniform(9.5, 15.0), rng.uniform(8.0, 12.0), width - rng.uniform(0.5, 3.0)
        x, y = site.outward(frontage, middle, setback)
        back = np.array([-np.sin(heading), np.cos(heading)]) * depth / 2
        if site.claim(x + back[0], y + back[1], wide, depth, heading, clearance_m=8.5):
            yield _stood(site, buildings.building(rng, wide, depth), x, y, heading)
    else:
        for _ in range(int(rng.integers(2, 7))):
            yield from _shrub(site, frontage, middle, width, rng)
    kind = rng.uniform()
    x, y = site.outward(frontage, middle, FRONT_M)
    length = width - rng.uniform(1.0, 5.0)
    if kind < config.hedged + config.fenced and site.claim(x, y, length, 1.0, heading, clearance_m=7.5):
        if kind < config.hedged:
            yield _stood(site, plants.hedge(rng, length, rng.uniform(0.7, 1.2), rng.uniform(0.9, 2.1)), x, y, heading)
        else:
            yield _stood(site, buildings.fence(rng, length), x, y, heading)


def _shrub(site: Site, frontage: Frontage, middle: int, width: float, rng: np.random.Generator) -> Iterator[Mesh]:
    """A tree or a bush somewhere in a garden or park."""
    station = int(np.clip(middle + rng.uniform(-0.5, 0.5) * width, 0, len(frontage.at) - 1))
    x, y = site.outward(frontage, station, rng.uniform(10.0, 40.0))
    tall = rng.uniform(1.0, 3.5)
    thing = plants.tree(rng) if rng.uniform() < 0.4 else plants.bush(rng, rng.uniform(1.2, 3.5), tall)
    if site.claim(x, y, 1.5, 1.5, 0.0, clearance_m=9.0):
        yield _stood(site, thing, x, y, float(rng.uniform(0, 2 * np.pi)))


def _stood(site: Site, thing: Mesh, x: float, y: float, yaw_rad: float) -> Mesh:
    z = float(site.ground.height_at(np.array([x]), np.array([y]))[0])
    return placed(thing, x, y, z, yaw_rad=yaw_rad)
