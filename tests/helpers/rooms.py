"""Keyframes in a square yard between walls, through which one thing passes: what a map should keep is known."""

import numpy as np

from segslam.core import geometry
from segslam.core.types import Keyframe, Label, Transform

HALF_M = 12.0
SENSOR_M = 1.7
WALL_TOP_M = 4.0
STEP_M = 0.15
PLACES = ((-4.0, -3.0), (-2.0, 0.0), (0.0, 2.0), (2.0, -2.0), (4.0, 3.0), (5.0, -4.0))
THING_AT = (1.0, 6.0)


def placed_keyframes(thing_in: int | None = 2) -> list[tuple[Keyframe, Transform]]:
    """Keyframes and their poses; the thing, labelled a car, stands in the one of this number, and hides what is behind.

    The world's z is 0 at the sensor, so that the ground is at -SENSOR_M.
    """
    return [
        (_keyframe(number, place, with_thing=number == thing_in), _pose(number, place))
        for number, place in enumerate(PLACES)
    ]


def ground_and_walls() -> tuple[np.ndarray, np.ndarray]:
    """Points of the world, and labels."""
    along = np.arange(-HALF_M, HALF_M, STEP_M) + 0.01
    x, y = (axis.ravel() for axis in np.meshgrid(along, along))
    ground = np.column_stack([x, y, np.full(len(x), -SENSOR_M)])
    s, up = (axis.ravel() for axis in np.meshgrid(along, np.arange(0.05, WALL_TOP_M, STEP_M) - SENSOR_M))
    sides = [np.column_stack(side) for side in ((s, 0 * s + HALF_M, up), (s, 0 * s - HALF_M, up))]
    sides += [np.column_stack(side) for side in ((0 * s + HALF_M, s, up), (0 * s - HALF_M, s, up))]
    walls = np.concatenate(sides)
    labels = np.repeat([int(Label.ROAD), int(Label.BUILDING)], [len(ground), len(walls)]).astype(np.uint8)
    return np.concatenate([ground, walls]), labels


def thing() -> np.ndarray:
    """Points of a slab of 2 m by 1.6 m that stands on the ground."""
    x, up = (a.ravel() for a in np.meshgrid(np.arange(-1.0, 1.0, STEP_M), np.arange(0.3, 1.6, STEP_M) - SENSOR_M))
    return np.column_stack([x + THING_AT[0], np.full(len(x), THING_AT[1]), up])


def _pose(number: int, place: tuple[float, float]) -> Transform:
    return geometry.transform(geometry.yaw(0.7 * number), [*place, 0.0])


def _keyframe(number: int, place: tuple[float, float], *, with_thing: bool) -> Keyframe:
    points, labels = ground_and_walls()
    if with_thing:
        hidden = _behind_the_thing(points, np.array(place))
        slab = thing()
        points = np.concatenate([points[~hidden], slab])
        labels = np.append(labels[~hidden], np.full(len(slab), Label.CAR, np.uint8))
    T_keyframe_world = geometry.inverse(_pose(number, place))
    seen = geometry.apply(T_keyframe_world, points).astype(np.float32)
    return Keyframe(number, number, number, np.eye(4), 0.0, seen, labels)


def _behind_the_thing(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Whether the ray from a place, at the height of the sensor, meets the slab's plane within it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (THING_AT[1] - place[1]) / (points[:, 1] - place[1])
        x = place[0] + share * (points[:, 0] - place[0])
        z = share * points[:, 2]
    return (share > 0) & (share < 1) & (np.abs(x - THING_AT[0]) < 1.1) & (z < 1.7 - SENSOR_M)
