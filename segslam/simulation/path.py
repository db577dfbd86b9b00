"""The way that a drive takes over the ground, and when."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from segslam.trajectory import Poses
from segslam.types import Points, Vector

BEYOND_M = 60.0  # chosen: the street is seen this far past the ends of the drive
APART_M = 15.0  # chosen: but not where it would come this near to another piece of the drive
PASS_M = 12.0  # chosen: passing a place means coming this near to it
VISIT_GAP_S = 5.0  # chosen: away for less is no second visit


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """The road under a drive, a row a pose: where, when (s), and after how much travel in the plane (m)."""

    at: Points
    time_s: Vector
    travel_m: Vector


def route_of(T_world_lidar: Poses, time_s: Vector, *, sensor_height_m: float) -> Route:
    """The road right under the sensor."""
    at = T_world_lidar[:, :3, 3] - np.array([0.0, 0.0, sensor_height_m])
    steps = np.linalg.norm(np.diff(at[:, :2], axis=0), axis=1)
    return Route(at, np.asarray(time_s, dtype=np.float64), np.concatenate([[0.0], np.cumsum(steps)]))


def street_of(route: Route, T_world_lidar: Poses) -> Points:
    """(n, 3) the route at steps of at most a metre, with the street going on straight before it and after it."""
    length = route.travel_m[-1]
    stations = np.linspace(0.0, length, int(np.ceil(length)) + 1)
    moving = np.concatenate([[True], np.diff(route.travel_m) > 1e-6])
    driven = np.column_stack([np.interp(stations, route.travel_m[moving], route.at[moving, axis]) for axis in range(3)])
    before = _straight_on(driven, route.at[0], -T_world_lidar[0, :2, 0])
    after = _straight_on(driven, route.at[-1], T_world_lidar[-1, :2, 0])
    return np.concatenate([before[::-1], driven, after])


def _straight_on(driven: Points, end: np.ndarray, heading: np.ndarray) -> Points:
    """Points a metre apart on from one end at its height, up to where the drive itself passes again."""
    reach = np.arange(1.0, BEYOND_M + 1.0)[:, None]
    points = end + np.hstack([reach * heading / np.linalg.norm(heading), np.zeros_like(reach)])
    elsewhere = driven[np.linalg.norm(driven[:, :2] - end[:2], axis=1) > APART_M]
    if len(elsewhere) == 0:
        return points
    distance, _ = cKDTree(elsewhere[:, :2]).query(points[:, :2])
    met = np.flatnonzero(distance < APART_M)
    return points[: met[0]] if len(met) else points


def time_between_visits(route: Route, x: float, y: float, rng: np.random.Generator) -> float | None:
    """A random moment (s) between two passes of a place, one after the other; None if it is passed but once."""
    near = np.linalg.norm(route.at[:, :2] - [x, y], axis=1) < PASS_M
    moments = route.time_s[near]
    gaps = np.flatnonzero(np.diff(moments) > VISIT_GAP_S)
    if len(gaps) == 0:
        return None
    gap = rng.choice(gaps)
    return float(rng.uniform(moments[gap], moments[gap + 1]))
