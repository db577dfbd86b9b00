"""Cars that move along the driven streets."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from segslam.bench.simulation import objects
from segslam.bench.simulation.mesh import Mesh, as_instance, placed
from segslam.bench.simulation.path import Route
from segslam.bench.simulation.world_settings import WorldConfig
from segslam.core.types import Label

LANE_M = 2.7  # chosen: offset of oncoming traffic to the left of the path
ONCOMING = 0.75  # chosen: share of oncoming cars; the others drive ahead of the sensor
SAFE_M = 5.5  # chosen: a moving car nearer than this would contain the sensor and is omitted


@dataclass(frozen=True, slots=True, eq=False)
class MovingCar:
    """A car, `lateral_m` to the left of the route. It is at travel `start_m` at time 0; `speed` (m/s) is signed."""

    mesh: Mesh
    start_m: float
    speed: float
    lateral_m: float


def moving_cars(route: Route, config: WorldConfig, rng: np.random.Generator) -> list[MovingCar]:
    """Oncoming cars and cars ahead, each of which meets the sensor at a random time of the drive."""
    count = rng.poisson(config.moving_cars * route.travel_m[-1] / 100.0)
    return [_moving_car(route, rng) for _ in range(count)]


def _moving_car(route: Route, rng: np.random.Generator) -> MovingCar:
    row = int(rng.integers(len(route.time_s)))
    oncoming = rng.uniform() < ONCOMING
    speed = -rng.uniform(6.0, 12.0) if oncoming else rng.uniform(8.0, 13.0)
    ahead = 0.0 if oncoming else rng.uniform(15.0, 30.0)
    start = route.travel_m[row] - speed * route.time_s[row] + ahead
    return MovingCar(objects.car(rng, Label.MOVING_CAR), float(start), float(speed), LANE_M if oncoming else 0.0)


def meshes_at(
    cars: Sequence[MovingCar], route: Route, *, time_s: float, near_xy: np.ndarray, view_m: float
) -> Iterator[Mesh]:
    """The moving cars at a time, within `view_m` of a position and not too near to it."""
    for number, car in enumerate(cars, start=1):
        travel = car.start_m + car.speed * time_s
        if not 1.0 < travel < route.travel_m[-1] - 1.0:
            continue
        behind, ahead = (_on_route(route, travel + step) for step in (-0.5, 0.5))
        heading = np.arctan2(ahead[1] - behind[1], ahead[0] - behind[0])
        x, y, z = (behind + ahead) / 2 + car.lateral_m * np.array([-np.sin(heading), np.cos(heading), 0.0])
        if SAFE_M < np.hypot(x - near_xy[0], y - near_xy[1]) < view_m:
            turn = heading + (np.pi if car.speed < 0 else 0.0)
            yield as_instance(placed(car.mesh, x, y, z, yaw_rad=turn), number)


def _on_route(route: Route, travel_m: float) -> np.ndarray:
    """(3,) position on the route after a distance of travel."""
    return np.array([np.interp(travel_m, route.travel_m, route.at[:, axis]) for axis in range(3)])
