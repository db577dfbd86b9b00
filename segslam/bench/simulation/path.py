"""The path of a drive on the ground, with times."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from segslam.core.trajectory import Poses
from segslam.core.types import Points, Vector

BEYOND_M = 60.0  # chosen: length of street added before the start and after the end of the drive
APART_M = 15.0  # chosen: the added street ends where it comes this near to another part of the drive
PASS_M = 12.0  # chosen: a place is visited when the sensor is this near
VISIT_GAP_S = 5.0  # chosen: least time between two visits


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """The road under a drive, one row per pose: position (m), time (s) and horizontal travel (m)."""

    at: Points
    time_s: Vector
    travel_m: Vector


def route_of(T_world_lidar: Poses, time_s: Vector, *, sensor_height_m: float) -> Route:
    """The road below the sensor."""
    at = T_world_lidar[:, :3, 3] - np.array([0.0, 0.0, sensor_height_m])
    steps = np.linalg.norm(np.diff(at[:, :2], axis=0), axis=1)
    return Route(at, np.asarray(time_s, dtype=np.float64), np.concatenate([[0.0], np.cumsum(steps)]))


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
