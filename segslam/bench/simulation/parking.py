"""Parked cars at the kerb and in courts, some of which arrive or leave during the drive."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from segslam.bench.simulation import objects
from segslam.bench.simulation.mesh import Mesh
from segslam.bench.simulation.path import Route, time_between_visits
from segslam.bench.simulation.site import Frontage, Site, Spot, displaced
from segslam.bench.simulation.world_settings import WorldConfig
from segslam.core.types import Label

KERB_M, SLOT_M = 4.4, 6.0  # chosen: distance of a parked car from the street's centre line; its length along the street
COURT_M, COURT_DEPTH_M, COURT_SLOT_M = (
    13.0,
    12.0,
    2.7,
)  # chosen: the same for courts, where cars are parked perpendicular to the street
VACANT = 0.3  # chosen: share of the parking places that are free on another day
TRUCKS = 0.05  # chosen: share of the vehicles at the kerb


@dataclass(frozen=True, slots=True, eq=False)
class ParkedCar:
    """A vehicle parked at `at` (x, y; m, world) for `start_s` <= time < `end_s`."""

    mesh: Mesh
    at: tuple[float, float]
    start_s: float
    end_s: float

    @property
    def changes(self) -> bool:
        """True if the car arrives or leaves during the drive."""
        return math.isfinite(self.start_s) or math.isfinite(self.end_s)


def parked_cars(
    site: Site,
    frontage: Frontage,
    route: Route,
    config: WorldConfig,
    rng: np.random.Generator,
    *,
    today: np.random.Generator | None = None,
) -> Iterator[ParkedCar]:
    """The cars on one side of the streets; in a share `parked_cars_gone` of the places they differ between visits.

    `rng` draws the parking places and the cars of the first day; `today` draws the cars of another day at these places.
    """
    for spot, across in [*_kerb_spots(site, frontage, config, rng), *_court_spots(site, frontage, config, rng)]:
        first_day = list(_cars_at(spot, across, site, route, config, rng))  # advances `rng` equally on every day
        if today is None:
            yield from first_day
        elif today.uniform() >= VACANT:
            yield from _cars_at(spot, across, site, route, config, today)


def _cars_at(
    spot: Spot, across: bool, site: Site, route: Route, config: WorldConfig, rng: np.random.Generator
) -> Iterator[ParkedCar]:
    """The successive cars at one place."""
    turn = (np.pi / 2 if across else 0.0) + np.pi * rng.integers(2) + rng.normal(scale=0.03)
    for start, end in _stays(route, spot, config, rng):
        lorry = not across and rng.uniform() < TRUCKS
        made = objects.truck(rng) if lorry else objects.car(rng)
        yield ParkedCar(site.stand(made, spot, turn_rad=float(turn)), (spot.x, spot.y), start, end)


def _kerb_spots(
    site: Site, frontage: Frontage, config: WorldConfig, rng: np.random.Generator
) -> Iterator[tuple[Spot, bool]]:
    """Parking places along the kerb, parallel to the street."""
    if config.cars <= 0:
        return
    free_m = max(100.0 / config.cars - SLOT_M, 0.1)
    station = float(rng.uniform(0, SLOT_M))
    while station < len(frontage.at) - 1:
        spot = site.outward(frontage, int(station), KERB_M + rng.normal(scale=0.1))
        if site.claim(spot, 5.6, 1.6, clearance_m=2.0):
            yield spot, False
        station += SLOT_M + rng.exponential(free_m)


def _court_spots(
    site: Site, frontage: Frontage, config: WorldConfig, rng: np.random.Generator
) -> Iterator[tuple[Spot, bool]]:
    """Parking places perpendicular to the street, in paved courts between the houses."""
    for _ in range(rng.poisson(config.courts * len(frontage.at) / 100.0)):
        width = rng.uniform(9.0, 22.0)
        middle = site.outward(frontage, int(rng.integers(len(frontage.at))), COURT_M)
        if site.claim(middle, width, COURT_DEPTH_M, clearance_m=5.5):
            site.pave(middle, width, COURT_DEPTH_M, Label.PARKING)
            for along in np.arange(-width / 2 + 1.5, width / 2 - 1.4, COURT_SLOT_M):
                if rng.uniform() < 0.5:
                    yield displaced(middle, along_m=float(along), out_m=rng.normal(scale=0.3)), True


def _stays(route: Route, spot: Spot, config: WorldConfig, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Periods (s) in which a car stands at one place: the whole drive, or two with a change between two visits."""
    changes = rng.uniform() < config.parked_cars_gone
    change = time_between_visits(route, spot.x, spot.y, rng) if changes else None
    if change is None:
        return [(-math.inf, math.inf)]
    left, came = (-math.inf, change), (change, math.inf)
    return [[left], [came], [left, came]][int(rng.integers(3))]
