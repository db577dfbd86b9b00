"""Objects along the streets, except cars: lots with houses and gardens, rows of trees, lamps and signs."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from segslam.bench.simulation import objects
from segslam.bench.simulation.mesh import Mesh
from segslam.bench.simulation.site import Frontage, Site, displaced
from segslam.bench.simulation.world_settings import WorldConfig
from segslam.core.types import Label

# Chosen: distances from the street's centre line to the centre of an object, or to the front of a house.
LAMP_M, SIGN_M, TREE_M, HEDGE_M = 5.8, 6.2, 6.9, 7.9
HOUSE_M, YARD_M, GARDEN_M, BACKDROP_M = (8.6, 13.0), (8.5, 12.0), (8.5, 18.0), (20.0, 50.0)
# Chosen: mean number of bushes and trees on a lot in front of the house, on a lot without house, and behind the house.
YARD_SHRUBS, GARDEN_SHRUBS, BACKDROP_SHRUBS = 1.5, 8.0, 3.5

Maker = Callable[[np.random.Generator], Mesh]


@dataclass(frozen=True, slots=True, eq=False)
class Lot:
    """A section of one side of the street, `width_m` wide, centred on the station `middle` of its frontage."""

    site: Site
    frontage: Frontage
    middle: int
    width_m: float


def furnish(site: Site, frontage: Frontage, config: WorldConfig, rng: np.random.Generator) -> Iterator[Mesh]:
    """All objects on one side, in the world frame: houses first, then objects that fit in front of them."""
    start = 0
    while start < len(frontage.at):
        width = int(rng.integers(9, 25))
        lot = Lot(site, frontage, min(start + width // 2, len(frontage.at) - 1), float(width))
        start += width
        if rng.uniform() < config.built:
            yield from _house(lot, rng)
            yield from _shrubs(lot, YARD_SHRUBS * config.shrubs, YARD_M, rng)
        else:
            yield from _shrubs(lot, GARDEN_SHRUBS * config.shrubs, GARDEN_M, rng)
        yield from _closure(lot, config, rng)
        yield from _shrubs(lot, BACKDROP_SHRUBS * config.shrubs, BACKDROP_M, rng)
    equal = config.equal_tree_rows
    make_tree: Maker = (lambda _: objects.tree(np.random.default_rng(0), scale=0.5)) if equal else objects.tree
    for per_100m, make, distance_m, jitter in (  # jitter: largest displacement along the street, in spacings
        (config.trees, make_tree, TREE_M, 0.0 if equal else 0.8),
        (config.lamps, objects.lamp, LAMP_M, 0.3),
        (config.signs, objects.sign, SIGN_M, 0.9),
        (config.clutter, objects.clutter, TREE_M, 0.9),
    ):
        if per_100m <= 0:
            continue
        spacing = 100.0 / per_100m
        for nominal in np.arange(spacing / 2, len(frontage.at), spacing):
            station = int(np.clip(nominal + rng.uniform(-jitter, jitter) * spacing, 0, len(frontage.at) - 1))
            spot = site.outward(frontage, station, distance_m + rng.uniform(0.0, 1.0) * min(jitter, 0.6))
            thing = make(rng)
            if site.claim(spot, 0.5, 0.5, clearance_m=3.0):
                yield site.stand(thing, spot, turn_rad=float(rng.normal(scale=0.05)))


def _house(lot: Lot, rng: np.random.Generator) -> Iterator[Mesh]:
    """A building with a paved path to its door; some adjoin the next building."""
    depth, wide = rng.uniform(8.0, 12.0), lot.width_m - max(0.0, rng.uniform(-1.5, 3.0))
    spot = lot.site.outward(lot.frontage, lot.middle, rng.uniform(*HOUSE_M))
    if lot.site.claim(displaced(spot, out_m=depth / 2 + 0.5), wide, depth, clearance_m=6.5):
        yield lot.site.stand(objects.building(rng, wide, depth), spot)
        way = displaced(spot, along_m=rng.uniform(-0.3, 0.3) * wide, out_m=-3.0)
        lot.site.pave(way, 3.0, 6.0, Label.SIDEWALK)


def _closure(lot: Lot, config: WorldConfig, rng: np.random.Generator) -> Iterator[Mesh]:
    """A hedge, a fence or nothing between lot and sidewalk."""
    kind, length = rng.uniform(), lot.width_m - rng.uniform(1.0, 5.0)
    spot = lot.site.outward(lot.frontage, lot.middle, HEDGE_M)
    if kind < config.hedged + config.fenced and lot.site.claim(spot, length, 0.8, clearance_m=4.5):
        if kind < config.hedged:
            yield lot.site.stand(objects.hedge(rng, length, rng.uniform(0.7, 1.1), rng.uniform(0.9, 2.2)), spot)
        else:
            yield lot.site.stand(objects.fence(rng, length), spot)


def _shrubs(lot: Lot, mean: float, distance_m: tuple[float, float], rng: np.random.Generator) -> Iterator[Mesh]:
    """Bushes, and one tree for three of them, at random distances in this range from the street's centre line."""
    for _ in range(rng.poisson(mean)):
        away = rng.uniform(-0.5, 0.5) * lot.width_m
        station = int(np.clip(lot.middle + away, 0, len(lot.frontage.at) - 1))
        spot = lot.site.outward(lot.frontage, station, rng.uniform(*distance_m))
        bush = objects.bush(rng, rng.uniform(1.4, 4.0), rng.uniform(0.8, 4.0))
        thing = objects.tree(rng) if rng.uniform() < 0.25 else bush
        if lot.site.claim(spot, 1.4, 1.4, clearance_m=6.0):
            yield lot.site.stand(thing, spot, turn_rad=float(rng.uniform(0.0, 2 * np.pi)))
