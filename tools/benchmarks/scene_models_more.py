"""Further scenes for registration tests: mine, warehouse, orchard, yard, office."""

import math
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from segslam.bench.simulation.mesh import Mesh, band, box, mesh, placed
from segslam.bench.simulation.objects import bush, tree
from segslam.core.types import Label
from tools.benchmarks.scene_parts import Scene, lifted, path_along, scene_of_parts, slab, uneven_ground, wall


def mine(seed: int) -> Scene:
    """A winding drift 4 m wide and 3.5 m high in rough rock."""
    rng, step_m, num_rings, num_corners = np.random.default_rng(seed), 0.5, 320, 24
    heading = np.cumsum(gaussian_filter1d(rng.normal(scale=0.14, size=num_rings), 8))
    centre = step_m * np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    angles = np.arange(num_corners) * (2 * np.pi / num_corners)
    sideways, upwards = 2.0 * np.cos(angles), np.clip(1.75 + 2.1 * np.sin(angles), 0.0, 3.5)
    rough = gaussian_filter(rng.normal(size=(num_rings, num_corners)), 1.2, mode=("nearest", "wrap"))
    wide = 1.0 + 0.25 * gaussian_filter1d(rng.normal(size=num_rings), 6) / 0.22
    scale = wide[:, None] + 0.12 * rough / rough.std()
    across = np.column_stack([-np.sin(heading), np.cos(heading)])
    flat = centre[:, None] + (scale * sideways)[:, :, None] * across[:, None]
    height = np.where(upwards > 0.0, scale * upwards, 0.03 * rough / rough.std())
    corners = np.concatenate([flat, height[:, :, None]], axis=2).reshape(-1, 3)
    triangles = np.concatenate([band(num_corners, num_corners) + num_corners * ring for ring in range(num_rings - 1)])
    rows = slice(40, num_rings - 40, 2)
    return scene_of_parts(
        [mesh(corners, triangles, Label.UNLABELLED)],
        path_along(centre[rows, 0], centre[rows, 1], 1.5, heading[rows]),
        6.0,
    )


def warehouse(seed: int) -> Scene:
    """Racks 7 m high with equal bays of 2.7 m, more than half of the places filled, 3 m of aisle between them."""
    rng, length_m, width_m = np.random.default_rng(seed), 64.0, 40.0
    rim = [(0.0, 0.0), (length_m, 0.0), (length_m, width_m), (0.0, width_m), (0.0, 0.0)]
    parts = [slab(0.0, length_m, 0.0, width_m, 0.0, Label.OTHER_GROUND), slab(0.0, length_m, 0.0, width_m, 9.0)]
    parts.append(wall(rim, 9.0))
    middles = np.arange(4.0, width_m - 2.0, 5.2)
    for y in middles:
        for x in np.arange(6.0, 59.0, 2.7):
            parts.append(box(0.1, 2.2, 0.0, 7.0, Label.UNLABELLED, at=(x, y)))
            for floor in (0.15, 1.9, 3.65, 5.4):
                parts.append(lifted(box(2.6, 2.2, 0.0, 0.12, Label.UNLABELLED, at=(x + 1.35, y)), floor - 0.12))
                parts += [
                    box(rng.uniform(0.9, 1.2), 2 * rng.uniform(0.8, 1.05), floor, floor + rng.uniform(0.5, 1.5),
                        Label.UNLABELLED, at=(x + side, y + rng.normal(scale=0.04)))
                    for side in (0.75, 1.95) if rng.random() < 0.6
                ]  # fmt: skip
    along = np.arange(8.0, 56.0, 0.75)
    aisles = (middles[1] + 2.6, 0.0), (middles[4] + 2.6, np.pi)
    paths = [path_along(along, np.full_like(along, y), 1.6, yaw) for y, yaw in aisles]
    return scene_of_parts(parts, np.concatenate(paths), 8.0)


def orchard(seed: int) -> Scene:
    """Rows of small trees, 4.5 m between the rows and 3 m between the trees, some missing; uneven ground."""
    rng, size = np.random.default_rng(seed), 90.0
    parts = [uneven_ground(rng, size, 1.2)]
    rows = np.arange(0.0, size, 4.5)
    for y in rows:
        for x in np.arange(0.0, size, 3.0):
            if rng.random() < 0.93:
                dx, dy = rng.normal(scale=0.12, size=2)
                parts.append(placed(tree(rng, scale=rng.uniform(0.4, 0.5)), x + dx, y + dy, 0.0))
    along = np.arange(18.0, size - 18.0, 1.0)
    lanes = (rows[7] + 2.25, 0.0), (rows[11] + 2.25, np.pi)
    paths = [path_along(along, np.full_like(along, y), 1.6, yaw) for y, yaw in lanes]
    return scene_of_parts(parts, np.concatenate(paths), 8.0)


def yard(seed: int) -> Scene:
    """A yard of 46 x 36 m between facades, around a lower building; pilasters, bays, trees, bushes and benches."""
    rng = np.random.default_rng(seed)
    parts = [slab(-2.0, 48.0, -2.0, 38.0, 0.0, Label.OTHER_GROUND)]
    parts += _facades([(0.0, 0.0), (46.0, 0.0), (46.0, 36.0), (0.0, 36.0)], 13.0, rng)
    parts += _facades([(15.0, 12.0), (15.0, 24.0), (31.0, 24.0), (31.0, 12.0)], 8.0, rng)
    around = np.array([(7.5, 6.0), (38.5, 6.0), (38.5, 30.0), (7.5, 30.0), (7.5, 6.0)])
    for _ in range(5):
        side, share = int(rng.integers(4)), rng.uniform(0.05, 0.95)
        x, y = around[side] + share * (around[side + 1] - around[side]) + rng.choice([-3.0, 3.0], size=2)
        parts.append(placed(tree(rng, scale=0.7) if rng.random() < 0.5 else bush(rng, 1.6, 1.4), x, y, 0.0))
    for _ in range(6):
        height_m, at = rng.uniform(0.45, 1.2), (rng.uniform(2.0, 44.0), rng.choice([1.0, 35.0]))
        parts.append(box(1.8, 0.5, 0.0, height_m, Label.UNLABELLED, at=at))
    rows = [
        np.array([*(start + share * (end - start)), 1.6, math.atan2(*(end - start)[::-1])])
        for start, end in pairwise(around)
        for share in np.arange(0.0, 1.0, 0.75 / float(np.linalg.norm(end - start)))
    ]
    return scene_of_parts(parts, np.array(rows), 8.0)


def office(seed: int) -> Scene:
    """A corridor 1.8 m wide with equal rooms of 4.2 x 5 m at both sides, doors open, differently furnished."""
    rng, room_m, depth_m, num_rooms, height_m = np.random.default_rng(seed), 4.2, 5.0, 10, 2.7
    length_m = num_rooms * room_m
    far = 0.9 + depth_m
    parts = [slab(0.0, length_m, -far, far, 0.0, Label.OTHER_GROUND), slab(0.0, length_m, -far, far, height_m)]
    parts += [wall([(x, -far), (x, far)], height_m) for x in (0.0, length_m)]
    corridor_x = np.arange(3.0, length_m - 3.0, 0.5)
    paths = [path_along(corridor_x, np.zeros_like(corridor_x), 1.3, 0.0)]
    for side in (-1.0, 1.0):
        parts.append(wall([(0.0, side * far), (length_m, side * far)], height_m))
        for number in range(num_rooms):
            start = number * room_m
            door = start + rng.uniform(0.5, room_m - 1.4)
            ends = (start, door), (door + 0.9, start + room_m)
            parts += [wall([(a, side * 0.9), (b, side * 0.9)], height_m) for a, b in ends]
            parts.append(lifted(wall([(door, side * 0.9), (door + 0.9, side * 0.9)], height_m - 2.05), 2.05))
            parts.append(wall([(start, side * 0.9), (start, side * far)], height_m))
            for _ in range(int(rng.integers(3, 7))):
                size = rng.uniform(0.5, 1.6), rng.uniform(0.4, 0.8)
                at = start + rng.uniform(0.9, room_m - 0.9), side * rng.uniform(2.6, far - 0.6)
                parts.append(box(*size, 0.0, rng.choice([0.45, 0.75, 1.3, 2.0]), Label.UNLABELLED, at=at))
            if number % 3 == 1:
                inwards = np.arange(0.4, 1.6, 0.4)
                paths.append(path_along(np.full_like(inwards, door + 0.45), side * inwards, 1.3, side * np.pi / 2))
    return scene_of_parts(parts, np.concatenate(paths), 2.5)


def _facades(corners: list[tuple[float, float]], height_m: float, rng: np.random.Generator) -> list[Mesh]:
    """Walls between corners; what they have, pilasters and bays on up to three floors, stands out to the left."""
    parts = []
    for (x0, y0), (x1, y1) in pairwise([*corners, corners[0]]):
        length_m = math.hypot(x1 - x0, y1 - y0)
        outline, bays = [(0.0, 0.0)], []
        for start in np.cumsum(rng.uniform(2.2, 4.5, size=int(length_m / 3.0))):
            width, depth = rng.uniform(0.8, 1.8), rng.uniform(0.15, 0.5)
            if start + width > length_m - 1.0:
                break
            ledge = [(start, 0.0), (start, depth), (start + width, depth), (start + width, 0.0)]
            if rng.random() < 0.35:
                outline += ledge
            else:
                bays += [lifted(wall(ledge, 1.6), z) for z in (1.0, 4.2, 7.4) if z < height_m - 2.0]
        facade = [wall([*outline, (length_m, 0.0)], height_m), *bays]
        parts += [placed(part, x0, y0, 0.0, yaw_rad=math.atan2(y1 - y0, x1 - x0)) for part in facade]
    return parts


MORE_SCENES = {"mine": mine, "warehouse": warehouse, "orchard": orchard, "yard": yard, "office": office}
