"""Parked cars, some of which come or leave while the drive lasts, and cars that move."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from segslam.simulation import vehicles
from segslam.simulation.mesh import Mesh, as_instance, placed
from segslam.simulation.settings import WorldConfig
from segslam.simulation.site import Frontage, Site, Spot
from segslam.types import Label, Vector

CAR_M, SLOT_M = 4.4, 6.0  # chosen: from the street's middle to a parked car's; room that one takes
LANE_M = 2.7  # chosen: oncoming traffic passes this far to the left of the path
PASS_M = 12.0  # chosen: passing a place means coming this near to it
VISIT_GAP_S = 5.0
VIEW_M = 100.0
SAFE_M = 5.5  # chosen: a moving car this near to the sensor would be inside it and is left out


@dataclass(frozen=True, slots=True, eq=False)
class ParkedCar:
    """A vehicle in the world while `start_s` <= time < `end_s`."""

    mesh: Mesh
    at: tuple[float, float]
    start_s: float
    end_s: float

    @property
    def changes(self) -> bool:
        """Whether it comes or leaves at all."""
        return math.isfinite(self.start_s) or math.isfinite(self.end_s)


@dataclass(frozen=True, slots=True, eq=False)
class MovingCar:
    """A car on the path, `lateral_m` to its left: at `start_m` along it at time 0, then at `speed` (m/s, signed)."""

    mesh: Mesh
    start_m: float
    speed: float
    lateral_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """The drive itself: `at` (n, 3) on the road, when the car was there (s), and how far it had come (m)."""

    at: np.ndarray
    time_s: Vector
    travel_m: Vector

    def change_time(self, x: float, y: float, rng: np.random.Generator) -> float:
        """A moment between the first and the last pass of a place; infinite if it is passed but once."""
        near = np.linalg.norm(self.at[:, :2] - [x, y], axis=1) < PASS_M
        moments = self.time_s[near]
        gaps = np.flatnonzero(np.diff(moments) > VISIT_GAP_S)
        if len(gaps) == 0:
            return np.inf
        gap = rng.choice(gaps)
        return float(rng.uniform(moments[gap], moments[gap + 1]))


def parked_cars(
    site: Site, frontage: Frontage, route: Route, config: WorldConfig, rng: np.random.Generator
) -> Iterator[ParkedCar]:
    """Rows of cars at the kerb; at `parked_cars_gone` of the places they differ from visit to visit."""
    if config.cars <= 0:
        return
    free_m = max(100.0 / config.cars - SLOT_M, 0.1)
    station = float(rng.uniform(0, SLOT_M))
    while station < len(frontage.at) - 1:
        spot = site.outward(frontage, int(station), CAR_M + rng.normal(scale=0.1))
        if site.claim(spot, 5.6, 1.6, clearance_m=2.0):
            turn = float(rng.normal(scale=0.03) + np.pi * rng.integers(2))
            for start, end in _stays(route, spot, config, rng):
                made = vehicles.car(rng) if rng.uniform() < 0.95 else vehicles.truck(rng)
                yield ParkedCar(site.stand(made, spot, turn_rad=turn), (spot.x, spot.y), start, end)
        station += SLOT_M + rng.exponential(free_m)


def _stays(route: Route, spot: Spot, config: WorldConfig, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Who stands at one place, when: one car throughout, or a change between two visits."""
    change = route.change_time(spot.x, spot.y, rng) if rng.uniform() < config.parked_cars_gone else np.inf
    if not np.isfinite(change):
        return [(-np.inf, np.inf)]
    left, came = (-np.inf, change), (change, np.inf)
    return [[left], [came], [left, came]][int(rng.integers(3))]


def moving_cars(route: Route, config: WorldConfig, rng: np.random.Generator) -> list[MovingCar]:
    """Oncoming cars, and cars that lead or follow by some 15-40 m, spread over the drive."""
    count = rng.poisson(config.moving_cars * route.travel_m[-1] / 100.0)
    return [_moving_car(route, rng) for _ in range(count)]


def _moving_car(route: Route, rng: np.random.Generator) -> MovingCar:
    """A car that meets the sensor at a random moment of the drive."""
    row = int(rng.integers(len(route.time_s)))
    oncoming = rng.uniform() < 0.75
    speed = -rng.uniform(6.0, 12.0) if oncoming else rng.uniform(8.0, 13.0)
    start = route.travel_m[row] - speed * route.time_s[row] + (0.0 if oncoming else rng.uniform(15.0, 30.0))
    return MovingCar(vehicles.car(rng, Label.MOVING_CAR), float(start), float(speed), LANE_M if oncoming else 0.0)


def meshes_at(cars: list[MovingCar], route: Route, time_s: float, near_xy: np.ndarray) -> Iterator[Mesh]:
    """The moving cars where they are at a time, within VIEW_M of a point and not on top of it."""
    for number, car in enumerate(cars, start=1):
        travel = car.start_m + car.speed * time_s
        if not 1.0 < travel < route.travel_m[-1] - 1.0:
            continue
        here, ahead = (
            np.array([np.interp(travel + d, route.travel_m, route.at[:, axis]) for axis in range(3)])
            for d in (-0.5, 0.5)
        )
        heading = np.arctan2(*(ahead - here)[1::-1])
        x, y, z = (here + ahead) / 2 + car.lateral_m * np.array([-np.sin(heading), np.cos(heading), 0.0])
        if SAFE_M < np.hypot(x - near_xy[0], y - near_xy[1]) < VIEW_M:
            turn = heading + (np.pi if car.speed < 0 else 0.0)
            yield as_instance(placed(car.mesh, x, y, z, yaw_rad=turn), number)
