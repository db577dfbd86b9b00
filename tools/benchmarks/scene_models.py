"""Scenes other than streets, for registration tests: corridor, garage, tunnel, forest, parking lot, square, and more.

Sensors of several kinds scan them: 16 to 128 beams, high or narrow fields of view, a non-repetitive pattern.
"""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from segslam.bench.simulation.mesh import box, placed, stem
from segslam.bench.simulation.objects import bush, car, tree
from segslam.bench.simulation.world import cast_mesh, rays_of
from segslam.core import geometry
from segslam.core.types import Label, Points, Transform
from tools.benchmarks.scene_models_more import MORE_SCENES
from tools.benchmarks.scene_parts import Scene, lifted, path_along, scene_of_parts, slab, uneven_ground, wall

SENSORS = {
    "16": (16, (-15.0, 15.0), 360.0), "32": (32, (-25.0, 15.0), 360.0), "64": (64, (-22.5, 22.5), 360.0),
    "128": (128, (-22.5, 22.5), 360.0), "90 high": (64, (-45.0, 45.0), 360.0), "70 wide": (64, (-22.5, 22.5), 70.0),
    "non-repeating": (0, (-7.0, 52.0), 360.0),
}  # fmt: skip
"""Number of beams (0: random directions in each scan), lowest and highest elevation, horizontal view (degrees)."""
NUM_AZIMUTH = 720
NUM_DRAWN = 30_000
MIN_RANGE_M, MAX_RANGE_M = 0.5, 100.0
DROPOUT = 0.02


def corridor(seed: int, *, regular: bool = False) -> Scene:
    """A corridor 2.4 m wide and 2.6 m high with recessed doors.

    The doors are 3 m apart if `regular`. Otherwise their distances are irregular, and cupboards stand along the walls.
    """
    rng, length_m = np.random.default_rng(seed), 60.0
    parts = [slab(0.0, length_m, -1.2, 1.2, 0.0, Label.OTHER_GROUND), slab(0.0, length_m, -1.2, 1.2, 2.6)]
    parts += [wall([(x, -1.6), (x, 1.6)], 2.6) for x in (0.0, length_m)]
    for side in (-1.0, 1.0):
        if regular:
            doors = [(x, 1.0, 0.3) for x in np.arange(0.5, length_m - 1.5, 3.0)]
        else:
            starts = np.cumsum(rng.uniform(2.0, 6.5, size=int(length_m / 4.25)))
            doors = [(x, rng.choice([0.9, 1.0, 1.4]), rng.uniform(0.12, 0.4)) for x in starts if x < length_m - 2.0]
        line = [(0.0, side * 1.2)]
        for x, width, depth in doors:
            line += [(x, side * 1.2), (x, side * (1.2 + depth))]
            line += [(x + width, side * (1.2 + depth)), (x + width, side * 1.2)]
        parts.append(wall([*line, (length_m, side * 1.2)], 2.6))
        if not regular:
            parts += [
                box(rng.uniform(0.4, 1.2), rng.uniform(0.3, 0.45), 0.0, rng.uniform(0.8, 2.1), Label.UNLABELLED,
                    at=(x, side * 0.98))
                for x in rng.uniform(2.0, length_m - 2.0, size=int(length_m / 9))
            ]  # fmt: skip
    along = np.arange(6.0, length_m - 6.0, 0.5)
    return scene_of_parts(parts, path_along(along, 0.1 * np.sin(along), 1.0, 0.0), 6.0)


def garage(seed: int) -> Scene:
    """Three levels 3 m apart with the same pillars and walls, but different cars. The path runs through all levels."""
    rng = np.random.default_rng(seed)
    length, width = 64.0, 34.0
    parts, paths = [slab(0.0, length, 0.0, width, 0.0, Label.OTHER_GROUND)], []
    for level in range(3):
        floor = 3.0 * level
        parts.append(slab(0.0, length, 0.0, width, floor + 2.85))
        rim = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width), (0.0, 0.0)]
        parts.append(lifted(wall(rim, 1.1), floor))  # a parapet, open above
        stairs = [(28.0, 14.0), (36.0, 14.0), (36.0, 20.0), (28.0, 20.0), (28.0, 14.0)]
        parts.append(lifted(wall(stairs, 2.85), floor))
        pillars = [(x, y) for x in np.arange(8.0, length, 8.0) for y in (5.5, 11.5, 22.5, 28.5)]
        parts += [lifted(box(0.5, 0.5, 0.0, 2.85, Label.BUILDING, at=at), floor) for at in pillars]
        for y in (2.7, 14.2, 19.8, 31.3):
            parts += [
                placed(car(rng), x, y + rng.normal(0, 0.15), floor, yaw_rad=rng.choice([-1, 1]) * np.pi / 2)
                for x in np.arange(2.0, length - 1.0, 2.6)
                if rng.random() < 0.45 and not (26.0 < x < 38.0 and 10.0 < y < 24.0)
            ]
        along = np.arange(6.0, length - 6.0, 0.75)
        paths += [path_along(along, np.full_like(along, y), floor + 1.8, yaw) for y, yaw in ((8.4, 0.0), (25.6, np.pi))]
    return scene_of_parts(parts, np.concatenate(paths), 10.0)


def tunnel(seed: int) -> Scene:
    """A tunnel 10 m wide and 6 m high with niches, signs, lamps and cabinets at irregular distances."""
    rng, length_m = np.random.default_rng(seed), 240.0
    parts = [slab(0.0, length_m, -5.0, 5.0, 0.0, Label.ROAD), slab(0.0, length_m, -5.0, 5.0, 6.0)]
    for side in (-1.0, 1.0):
        line = [(0.0, side * 5.0)]
        for x in np.cumsum(rng.uniform(12.0, 32.0, size=int(length_m / 22))):
            if x < length_m - 5.0:
                line += [(x, side * 5.0), (x, side * 6.5), (x + 2.5, side * 6.5), (x + 2.5, side * 5.0)]
        parts.append(wall([*line, (length_m, side * 5.0)], 6.0))
        parts += [
            box(rng.uniform(0.5, 1.2), 0.5, 0.0, rng.uniform(1.2, 2.2), Label.UNLABELLED, at=(x, side * 4.75))
            for x in rng.uniform(5.0, length_m - 5.0, size=int(length_m / 12))
        ]
    parts += [
        lifted(box(rng.uniform(0.3, 0.9), rng.uniform(1.0, 2.5), 0.0, 0.6, Label.UNLABELLED, at=(x, 0.0)), 4.6)
        for x in rng.uniform(5.0, length_m - 5.0, size=int(length_m / 25))
    ]  # fans and signs under the ceiling
    along = np.arange(40.0, length_m - 40.0, 1.0)
    return scene_of_parts(parts, path_along(along, -1.8 + 0.2 * np.sin(along / 9.0), 1.8, 0.0), 10.0)


def forest(seed: int) -> Scene:
    """Trunks, crowns and bushes on uneven ground."""
    rng = np.random.default_rng(seed)
    size = 110.0
    parts = [uneven_ground(rng, size, 1.2)]
    at = rng.uniform(0.0, size, size=(420, 2))
    at = at[np.abs(at[:, 1] - size / 2 - 6.0 * np.sin(at[:, 0] / 15.0)) > 1.6]
    parts += [placed(tree(rng), x, y, 0.0) for x, y in at[:330]]
    parts += [placed(bush(rng, *rng.uniform(0.8, 2.2, 2)), x, y, 0.0) for x, y in at[330:]]
    along = np.arange(20.0, size - 20.0, 1.0)
    heading = np.arctan(0.4 * np.cos(along / 15.0))
    return scene_of_parts(parts, path_along(along, size / 2 + 6.0 * np.sin(along / 15.0), 1.8, heading), 8.0)


def parking_lot(seed: int) -> Scene:
    """Rows of identical cars 2.6 m apart, with a third of the places free; lamps, a hedge, a building at one side."""
    rng = np.random.default_rng(seed)
    equal = car(np.random.default_rng(7))
    parts = [slab(-60.0, 160.0, -60.0, 110.0, 0.0, Label.PARKING)]
    for y in np.arange(0.0, 60.0, 11.0):
        taken = [x for x in np.arange(0.0, 100.0, 2.6) if rng.random() < 0.67]
        parts += [placed(equal, x, y, 0.0, yaw_rad=np.pi / 2) for x in taken]
    parts += [
        placed(stem((0.09, 0.07), (0.0, 6.0), Label.POLE), x, y, 0.0) for x in (10.4, 46.8, 83.2) for y in (5.5, 38.5)
    ]
    parts.append(wall([(-10.0, 75.0), (35.0, 75.0), (35.0, 82.0), (70.0, 82.0)], 9.0))
    parts += [placed(tree(rng), x, -12.0 + rng.normal(0, 0.5), 0.0) for x in rng.uniform(-10.0, 110.0, 12)]
    along = np.arange(12.0, 90.0, 0.75)
    rows = [path_along(along, np.full_like(along, y), 1.8, yaw) for y, yaw in ((5.5 + 0.0, 0.0), (27.5, np.pi))]
    return scene_of_parts(parts, np.concatenate(rows), 10.0)


def square(seed: int) -> Scene:
    """An open paved square: facades at 35 to 55 m, a monument, lamps, a few trees."""
    rng = np.random.default_rng(seed)
    parts = [slab(-90.0, 90.0, -90.0, 90.0, 0.0, Label.OTHER_GROUND)]
    corners = [(-52.0, -40.0), (48.0, -45.0), (55.0, 38.0), (8.0, 46.0), (-45.0, 41.0), (-52.0, -40.0)]
    for (x0, y0), (x1, y1) in pairwise(corners):
        cuts = np.sort(np.concatenate([[0.0, 0.92], rng.uniform(0.05, 0.9, 4)]))
        for a, b in pairwise(cuts):
            back = rng.uniform(-2.5, 2.5) * np.array([-(y1 - y0), x1 - x0]) / np.hypot(x1 - x0, y1 - y0)
            ends = [np.array([x0, y0]) + share * np.array([x1 - x0, y1 - y0]) + back for share in (a, b)]
            parts.append(wall([tuple(end) for end in ends], rng.uniform(8.0, 16.0)))
    parts.append(box(3.0, 3.0, 0.0, 5.0, Label.UNLABELLED, at=(20.0, 12.0)))
    parts += [
        placed(stem((0.09, 0.07), (0.0, 6.0), Label.POLE), x, y, 0.0) for x, y in rng.uniform(-38.0, 38.0, (8, 2))
    ]
    parts += [placed(tree(rng), x, y, 0.0) for x, y in rng.uniform(-36.0, 36.0, (4, 2))]
    along = np.arange(-30.0, 30.0, 0.75)
    return scene_of_parts(parts, path_along(along, 0.3 * along, 1.8, np.arctan(0.3)), 12.0)


SCENES: dict[str, Callable[[int], Scene]] = {
    "corridor": corridor, "garage": garage, "tunnel": tunnel, "forest": forest, "parking lot": parking_lot,
    "square": square, **MORE_SCENES,
}  # fmt: skip


def pose(scene: Scene, row: int, rng: np.random.Generator, *, turned: bool = False) -> Transform:
    """A sensor pose at a row of the path, perturbed by centimetres and degrees; `turned`: rotated by 180 degrees."""
    x, y, z, heading = scene.path[row]
    side = rng.normal(scale=[0.15, 0.15, 0.03])
    tilt = geometry.exp(geometry.tangent(rotation_rad=np.radians(rng.normal(scale=[0.7, 0.7, 4.0])), translation_m=0.0))
    return geometry.transform(geometry.yaw(heading + np.pi * turned), np.array([x, y, z]) + side) @ tilt


def continuous_path(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The path of a scene (n, 4) as far as it leads without a jump, and the distance along it (n,)."""
    steps_m = np.linalg.norm(np.diff(scene.path[:, :3], axis=0), axis=1)
    path = scene.path[: 1 + int(np.argmax([*(steps_m > 2.0), True]))]
    return path, np.concatenate([[0.0], np.cumsum(steps_m[: len(path) - 1])])


def scan_points(
    scene: Scene, sensor: str, T_world_lidar: Transform, *, noise_m: float, rng: np.random.Generator
) -> Points:
    """One sweep (n, 3), float32, in the sensor's frame, with range noise and lost returns."""
    beams = beams_of(sensor, rng)
    return measured(scene, beams, rays_of(T_world_lidar, beams), noise_m=noise_m, rng=rng)[0]


def measured(
    scene: Scene, beams: Points, rays: np.ndarray, *, noise_m: float, rng: np.random.Generator
) -> tuple[Points, np.ndarray]:
    """Points (n, 3), float32, of the beams that return, and which these are; `rays`: of each beam, in the world."""
    ranges = cast_mesh(scene.rays, scene.mesh, rays).range_m
    seen = (ranges > MIN_RANGE_M) & (ranges < MAX_RANGE_M) & (rng.random(len(rays)) > DROPOUT)
    ranges = ranges[seen] + rng.normal(scale=noise_m, size=int(seen.sum()))
    return (beams[seen] * ranges[:, None]).astype(np.float32), seen


def beams_of(sensor: str, rng: np.random.Generator) -> Points:
    """Directions (n, 3) of the beams of one sweep."""
    beams, (low_deg, high_deg), width_deg = SENSORS[sensor]
    half = math.radians(width_deg) / 2
    if beams:
        azimuths = np.linspace(-half, half, int(NUM_AZIMUTH * width_deg / 360.0), endpoint=False)
        azimuth = np.repeat(azimuths, beams)
        elevation = np.tile(np.radians(np.linspace(low_deg, high_deg, beams)), len(azimuths))
    else:
        azimuth = rng.uniform(-half, half, NUM_DRAWN)
        elevation = np.radians(rng.uniform(low_deg, high_deg, NUM_DRAWN))
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
