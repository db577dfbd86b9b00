"""What stands along the streets: lots with houses and gardens, then rows of trees, lamps and signs."""

from collections.abc import Callable, Iterator

import numpy as np

from segslam.simulation import buildings, plants, vehicles
from segslam.simulation.mesh import Mesh
from segslam.simulation.settings import WorldConfig
from segslam.simulation.site import Frontage, Site, moved
from segslam.types import Label

# Chosen: from the street's middle to the middle of a thing, or to its face.
LAMP_M, SIGN_M, TREE_M, FRONT_M, HOUSE_M = 5.8, 6.2, 6.9, 7.9, (8.6, 13.0)
BACKDROP_M = (20.0, 50.0)

Maker = Callable[[np.random.Generator], Mesh]


def furnish(site: Site, frontage: Frontage, config: WorldConfig, rng: np.random.Generator) -> Iterator[Mesh]:
    """Everything that stands on one side, in the world: houses first, then what finds room before them."""
    yield from _lots(site, frontage, config, rng)
    tree_jitter = 0.0 if config.equal_tree_rows else 0.8
    yield from _row(site, frontage, rng, config.trees, _tree_maker(config), TREE_M, jitter=tree_jitter)
    yield from _row(site, frontage, rng, config.lamps, buildings.lamp, LAMP_M, jitter=0.3)
    yield from _row(site, frontage, rng, config.signs, buildings.sign, SIGN_M, jitter=0.9)
    yield from _row(site, frontage, rng, config.clutter, buildings.clutter, TREE_M, jitter=0.9)


def _row(
    site: Site,
    frontage: Frontage,
    rng: np.random.Generator,
    per_100m: float,
    make: Maker,
    distance_m: float,
    *,
    jitter: float,
) -> Iterator[Mesh]:
    """Things at a mean spacing along the street, each moved by up to `jitter` spacings either way."""
    if per_100m <= 0:
        return
    spacing = 100.0 / per_100m
    for nominal in np.arange(spacing / 2, len(frontage.at), spacing):
        station = int(np.clip(nominal + rng.uniform(-jitter, jitter) * spacing, 0, len(frontage.at) - 1))
        spot = site.outward(frontage, station, distance_m + rng.uniform(0.0, 1.0) * min(jitter, 0.6))
        thing = make(rng)
        if site.claim(spot, 0.5, 0.5, clearance_m=3.0):
            yield site.stand(thing, spot, turn_rad=float(rng.normal(scale=0.05)))


def _tree_maker(config: WorldConfig) -> Maker:
    def equal(_: np.random.Generator) -> Mesh:
        return plants.tree(np.random.default_rng(0), scale=0.5)

    return equal if config.equal_tree_rows else plants.tree


def _lots(site: Site, frontage: Frontage, config: WorldConfig, rng: np.random.Generator) -> Iterator[Mesh]:
    """Lot after lot of 9-24 m, each of one kind, closed towards the street or not."""
    start = 0
    while start < len(frontage.at):
        width = int(rng.integers(9, 25))
        middle = min(start + width // 2, len(frontage.at) - 1)
        kind = rng.uniform()
        if kind < config.built:
            yield from _house(site, frontage, middle, float(width), config, rng)
        elif kind < config.built + config.courts:
            yield from _court(site, frontage, middle, float(width), rng)
        else:
            yield from _garden(site, frontage, middle, float(width), config, rng)
        yield from _closure(site, frontage, middle, float(width), config, rng)
        for _ in range(rng.poisson(3.5 * config.shrubs)):
            yield from _shrub(site, frontage, middle, float(width), BACKDROP_M, rng)
        start += width


def _house(
    site: Site, frontage: Frontage, middle: int, width: float, config: WorldConfig, rng: np.random.Generator
) -> Iterator[Mesh]:
    """A building, with shrubs before it and a paved way to its door."""
    depth, wide = rng.uniform(8.0, 12.0), width - max(0.0, rng.uniform(-1.5, 3.0))
    spot = site.outward(frontage, middle, rng.uniform(*HOUSE_M))
    if site.claim(moved(spot, out_m=depth / 2 + 0.5), wide, depth, clearance_m=6.5):
        yield site.stand(buildings.building(rng, wide, depth), spot)
        site.pave(moved(spot, along_m=rng.uniform(-0.3, 0.3) * wide, out_m=-3.0), 3.0, 6.0, Label.SIDEWALK)
    for _ in range(rng.poisson(1.5 * config.shrubs)):
        yield from _shrub(site, frontage, middle, width, (8.5, 12.0), rng)


def _garden(
    site: Site, frontage: Frontage, middle: int, width: float, config: WorldConfig, rng: np.random.Generator
) -> Iterator[Mesh]:
    """Trees and bushes."""
    for _ in range(rng.poisson(8.0 * config.shrubs)):
        yield from _shrub(site, frontage, middle, width, (8.5, 18.0), rng)


def _court(site: Site, frontage: Frontage, middle: int, width: float, rng: np.random.Generator) -> Iterator[Mesh]:
    """A paved court with cars nose to the street, which opens the view."""
    site.pave(site.outward(frontage, middle, 16.0), width, 20.0, Label.PARKING)
    for along in np.arange(-width / 2 + 2.0, width / 2 - 1.5, 2.7):
        spot = moved(site.outward(frontage, middle, 12.5), along_m=float(along), out_m=rng.normal(scale=0.3))
        made = vehicles.car(rng)
        if rng.uniform() < 0.5 and site.claim(spot, 2.2, 5.0, clearance_m=6.0):
            yield site.stand(made, spot, turn_rad=np.pi / 2 + np.pi * rng.integers(2) + rng.normal(scale=0.04))


def _closure(
    site: Site, frontage: Frontage, middle: int, width: float, config: WorldConfig, rng: np.random.Generator
) -> Iterator[Mesh]:
    """A hedge or a fence between lot and sidewalk, if any."""
    kind, length = rng.uniform(), width - rng.uniform(1.0, 5.0)
    spot = site.outward(frontage, middle, FRONT_M)
    if kind < config.hedged + config.fenced and site.claim(spot, length, 0.8, clearance_m=4.5):
        if kind < config.hedged:
            yield site.stand(plants.hedge(rng, length, rng.uniform(0.7, 1.1), rng.uniform(0.9, 2.2)), spot)
        else:
            yield site.stand(buildings.fence(rng, length), spot)


def _shrub(
    site: Site,
    frontage: Frontage,
    middle: int,
    width: float,
    distance_m: tuple[float, float],
    rng: np.random.Generator,
) -> Iterator[Mesh]:
    """A tree or a bush somewhere on a lot."""
    station = int(np.clip(middle + rng.uniform(-0.5, 0.5) * width, 0, len(frontage.at) - 1))
    spot = site.outward(frontage, station, rng.uniform(*distance_m))
    thing = plants.tree(rng) if rng.uniform() < 0.25 else plants.bush(rng, rng.uniform(1.4, 4.0), rng.uniform(0.8, 4.0))
    if site.claim(spot, 1.4, 1.4, clearance_m=6.0):
        yield site.stand(thing, spot, turn_rad=float(rng.uniform(0.0, 2 * np.pi)))
