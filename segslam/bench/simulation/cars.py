"""Cars: parked at the kerb and in courts, where some arrive or leave during the drive, and moving along the streets."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from segslam.bench.simulation import objects
from segslam.bench.simulation.mesh import Mesh, as_instance, placed
from segslam.bench.simulation.site import Frontage, Route, Site, Spot, displaced, time_between_visits
from segslam.bench.simulation.world_settings import WorldConfig
from segslam.core.types import Label

KERB_M, SLOT_M = 4.4, 6.0  # chosen: distance of a parked car from the street's centre line; its length along the street
# Chosen: the same for courts, where cars are parked perpendicular to the street, and the depth of a court.
COURT_M, COURT_SLOT_M, COURT_DEPTH_M = 13.0, 2.7, 12.0
VACANT = 0.3  # chosen: share of the parking places that are free on another day
TRUCKS = 0.05  # chosen: share of the vehicles at the kerb
LANE_M = 2.7  # chosen: offset of oncoming traffic to the left of the path
ONCOMING = 0.75  # chosen: share of oncoming cars; the others drive ahead of the sensor
SAFE_M = 5.5  # chosen: a moving car nearer than this would contain the sensor and is omitted


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
    """The cars at one place: one for the whole drive, or with a change between two visits."""
    turn = (np.pi / 2 if across else 0.0) + np.pi * rng.integers(2) + rng.normal(scale=0.03)
    changes = rng.uniform() < config.parked_cars_gone
    change = time_between_visits(route, spot.x, spot.y, rng) if changes else None
    stays = [(-math.inf, math.inf)]
    if change is not None:
        left, came = (-math.inf, change), (change, math.inf)
        stays = [[left], [came], [left, came]][int(rng.integers(3))]
    for start, end in stays:
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


@dataclass(frozen=True, slots=True, eq=False)
class MovingCar:
    """A car, `lateral_m` to the left of the route. It is at travel `start_m` at time 0; `speed` (m/s) is signed."""

    mesh: Mesh
    start_m: float
    speed: float
    lateral_m: float


def moving_cars(route: Route, config: WorldConfig, rng: np.random.Generator) -> list[MovingCar]:
    """Oncoming cars and cars ahead, each of which meets the sensor at a random time of the drive."""
    cars = []
    for _ in range(rng.poisson(config.moving_cars * route.travel_m[-1] / 100.0)):
        row = int(rng.integers(len(route.time_s)))
        oncoming = rng.uniform() < ONCOMING
        speed = -rng.uniform(6.0, 12.0) if oncoming else rng.uniform(8.0, 13.0)
        ahead = 0.0 if oncoming else rng.uniform(15.0, 30.0)
        start = route.travel_m[row] - speed * route.time_s[row] + ahead
        lateral_m = LANE_M if oncoming else 0.0
        cars.append(MovingCar(objects.car(rng, Label.MOVING_CAR), float(start), float(speed), lateral_m))
    return cars


def meshes_at(
    cars: Sequence[MovingCar], route: Route, *, time_s: float, near_xy: np.ndarray, view_m: float
) -> Iterator[Mesh]:
    """The moving cars at a time, within `view_m` of a position and not too near to it."""
    for number, car in enumerate(cars, start=1):
        travel = car.start_m + car.speed * time_s
        if not 1.0 < travel < route.travel_m[-1] - 1.0:
            continue
        near_m = travel - 0.5, travel + 0.5
        behind, ahead = np.column_stack([np.interp(near_m, route.travel_m, axis) for axis in route.at.T])
        heading = np.arctan2(ahead[1] - behind[1], ahead[0] - behind[0])
        x, y, z = (behind + ahead) / 2 + car.lateral_m * np.array([-np.sin(heading), np.cos(heading), 0.0])
        if SAFE_M < np.hypot(x - near_xy[0], y - near_xy[1]) < view_m:
            turn = heading + (np.pi if car.speed < 0 else 0.0)
            yield as_instance(placed(car.mesh, x, y, z, yaw_rad=turn), number)
