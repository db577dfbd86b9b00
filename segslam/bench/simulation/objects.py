"""Objects along the streets, of varying shape, with the origin on the ground: houses, cars (x ahead), trees, ..."""

import numpy as np

from segslam.bench.simulation.mesh import Mesh, box, extruded, frustum, join_meshes, leaves, mesh, placed, stem
from segslam.core import geometry
from segslam.core.types import Label, Vector

STOREYS_M = (0.0, 0.9, 2.2, 3.6, 4.9, 6.4, 7.7)  # heights of sills and lintels, alternating
CAR_KINDS = (  # share; ranges of length, width, height (m); ranges of hood and boot as shares of the length
    (0.40, (3.6, 4.1), (1.62, 1.75), (1.42, 1.55), (0.22, 0.28), (0.00, 0.04)),  # hatchback
    (0.25, (4.3, 4.9), (1.70, 1.85), (1.38, 1.48), (0.24, 0.30), (0.14, 0.20)),  # saloon
    (0.20, (4.4, 4.9), (1.72, 1.90), (1.45, 1.75), (0.22, 0.28), (0.00, 0.03)),  # estate
    (0.15, (4.6, 5.6), (1.85, 2.00), (1.85, 2.10), (0.10, 0.18), (0.00, 0.02)),  # van
)


def building(rng: np.random.Generator, width_m: float, depth_m: float) -> Mesh:
    """A house of 1-3 storeys. The front is along x and faces -y; the origin is the middle of the front."""
    storeys = rng.integers(1, 4)
    levels = np.array([-1.0, *STOREYS_M[1 : 2 * storeys + 1], STOREYS_M[2 * storeys] + 1.2])
    front = wall(rng, width_m, levels, relief=1.0)
    back = placed(wall(rng, width_m, levels, relief=0.5), 0.0, depth_m, 0.0, yaw_rad=np.pi)
    sides = [
        placed(wall(rng, depth_m, levels, relief=0.4), sign * width_m / 2, depth_m / 2, 0.0, yaw_rad=sign * np.pi / 2)
        for sign in (-1, 1)
    ]
    core = box(width_m - 1.0, depth_m - 1.0, levels[-1] - 0.5, levels[-1], Label.BUILDING, at=(0.0, depth_m / 2))
    return join_meshes([front, back, *sides, core])


def wall(rng: np.random.Generator, width_m: float, levels: Vector, *, relief: float) -> Mesh:
    """A facade along x at y = 0, visible from -y, divided into bays with windows, doors, oriels and recesses.

    `levels` (k,): heights (m) of sills and lintels, alternating, between which the panels lie. `relief`: share of the
    bays, 0 to 1, that differ from a plain window.
    """
    inner = np.cumsum(rng.uniform(0.8, 2.4, size=int(width_m)))
    edges = np.concatenate([[0.0], inner[inner < width_m - 0.8], [width_m]]) - width_m / 2
    depth = np.zeros((len(levels) - 1, len(edges) - 1))
    kinds = rng.uniform(size=depth.shape[1])
    depth[1::2, kinds > 0.35] = 0.18  # window panes are recessed
    oriel, door, passage = kinds < 0.12 * relief, kinds > 1 - 0.15 * relief, kinds > 1 - 0.06 * relief
    depth[:, oriel] -= rng.uniform(0.3, 0.9)
    depth[:2, door] = 0.35
    depth[:2, passage] = rng.uniform(0.8, 2.0)
    return panels(edges, levels, depth)


def panels(edges: Vector, levels: Vector, depth: np.ndarray) -> Mesh:
    """Vertical panels (rows between levels, columns between edges), `depth` (m) behind y = 0, with their side faces."""
    rows, columns = np.indices(depth.shape)
    x0, x1 = edges[columns], edges[columns + 1]
    z0, z1 = levels[rows], levels[rows + 1]
    faces = _quads((x0, depth, z0), (x1, depth, z0), (x1, depth, z1), (x0, depth, z1))
    left, right, x = depth[:, :-1], depth[:, 1:], x1[:, :-1]
    jambs = _quads((x, left, z0[:, 1:]), (x, right, z0[:, 1:]), (x, right, z1[:, 1:]), (x, left, z1[:, 1:]))
    low, high, z = depth[:-1], depth[1:], z1[:-1]
    sills = _quads((x0[1:], low, z), (x1[1:], low, z), (x1[1:], high, z), (x0[1:], high, z))
    stepped = [left != right, low != high]
    quads = np.concatenate([faces, jambs[stepped[0].ravel()], sills[stepped[1].ravel()]])
    first = 4 * np.arange(len(quads))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return mesh(quads.reshape(-1, 3), triangles, Label.BUILDING)


def _quads(*corners: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """(q, 4, 3) quadrilaterals from four corners, each given as three coordinate arrays of the same shape."""
    return np.stack([np.stack(np.broadcast_arrays(*corner), axis=-1).reshape(-1, 3) for corner in corners], axis=1)


def fence(rng: np.random.Generator, length_m: float) -> Mesh:
    """A picket fence along x, 0.9-1.5 m tall."""
    height, pitch = rng.uniform(0.9, 1.5), rng.uniform(0.14, 0.24)
    pickets = [
        box(pitch * 0.6, 0.03, 0.05, height, Label.FENCE, at=(x, 0.0))
        for x in np.arange(-length_m / 2, length_m / 2, pitch)
    ]
    posts = [
        box(0.1, 0.1, 0.0, height + 0.1, Label.FENCE, at=(x, 0.06)) for x in np.arange(-length_m / 2, length_m / 2, 2.5)
    ]
    return join_meshes([*pickets, *posts])


def lamp(rng: np.random.Generator) -> Mesh:
    """A street lamp, 5-8 m tall."""
    height, radius = rng.uniform(5.0, 8.0), rng.uniform(0.06, 0.10)
    return stem((1.6 * radius, 1.6 * radius, radius, radius), (-0.2, 0.9, 1.0, height), Label.POLE)


def sign(rng: np.random.Generator) -> Mesh:
    """A traffic sign with its post; the plate faces -x."""
    height, width, tall = rng.uniform(2.1, 2.9), rng.uniform(0.45, 0.75), rng.uniform(0.45, 0.9)
    plate = box(0.02, width, height - tall, height, Label.TRAFFIC_SIGN, at=(-0.06, 0.0))
    return join_meshes([stem((0.035, 0.035), (-0.2, height), Label.POLE, sides=6), plate])


def clutter(rng: np.random.Generator) -> Mesh:
    """A bin, a switch box or a similar object without a class."""
    return box(rng.uniform(0.4, 1.2), rng.uniform(0.35, 0.7), 0.0, rng.uniform(0.8, 1.5), Label.UNLABELLED)


def car(rng: np.random.Generator, label: Label = Label.CAR) -> Mesh:
    """A car with hood, glass windows and wheels, 3.6-5.6 m long; it depends on the state of `rng` only."""
    shares = np.array([kind[0] for kind in CAR_KINDS])
    _, *ranges = CAR_KINDS[rng.choice(len(CAR_KINDS), p=shares)]
    length, width, height, hood, boot = (rng.uniform(*bounds) for bounds in ranges)
    belt = height * rng.uniform(0.58, 0.64)
    nose, tail = length / 2, -length / 2
    body = np.array(
        [[tail, 0.25], [nose, 0.25], [nose, belt * 0.72], [nose - 0.12, belt * 0.85], [nose - hood * length, belt],
         [tail + 0.05, belt], [tail, belt * 0.8]]
    )  # fmt: skip
    front, back = nose - hood * length + 0.1, tail + boot * length + 0.03
    middle, cabin = (front + back) / 2, front - back
    roof = (cabin * rng.uniform(0.62, 0.74), width * 0.74, middle - cabin * 0.06)
    glazed = frustum((cabin, width * 0.94, middle), roof, belt, height - 0.06, label, glass=True)
    return join_meshes(
        [
            extruded(body, width, label),
            glazed,
            frustum(roof, roof, height - 0.06, height, label),
            _wheels(length, width, label),
        ]
    )


def truck(rng: np.random.Generator) -> Mesh:
    """A lorry with cab and cargo box, 5.5-9 m long."""
    length, width, height = rng.uniform(5.5, 9.0), rng.uniform(2.1, 2.5), rng.uniform(2.7, 3.5)
    cab = rng.uniform(1.6, 2.1)
    return join_meshes(
        [
            box(cab, width * 0.95, 0.45, min(height, 2.6), Label.TRUCK, at=(length / 2 - cab / 2, 0.0)),
            box(length - cab - 0.25, width, 0.9, height, Label.TRUCK, at=(-cab / 2 - 0.12, 0.0)),
            _wheels(length, width, Label.TRUCK),
        ]
    )


def _wheels(length: float, width: float, label: Label) -> Mesh:
    """Four short boxes, the visible parts of the wheels."""
    return join_meshes(
        [
            box(0.6, 0.2, 0.0, 0.3, label, at=(sx * length * 0.31, sy * (width / 2 - 0.12)))
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
    )


def tree(rng: np.random.Generator, *, scale: float | None = None) -> Mesh:
    """A tree with a trunk of 2-4 m and a crown of leaves. `scale`: 0 (small) to 1 (large); random by default."""
    size = rng.uniform() if scale is None else scale
    radius, clear = 0.10 + 0.16 * size, 2.0 + 1.6 * size
    spread, rise = 1.2 + 1.8 * size, 1.3 + 1.7 * size
    trunk = stem(
        (1.5 * radius, radius, 0.8 * radius, 0.4 * radius),
        (-0.3, 0.4, clear, clear + rise),
        Label.TRUNK,
        lean=rng.normal(scale=0.03),
    )
    crown = _ball(rng, 220, hollow=0.3) * [spread, spread, rise] + [0.0, 0.0, clear + 0.7 * rise]
    return join_meshes([trunk, leaves(crown, 0.55, rng)])


def bush(rng: np.random.Generator, width_m: float, height_m: float) -> Mesh:
    """A round shrub that reaches the ground."""
    count = int(40 + 45 * width_m * height_m)
    half = _ball(rng, count, hollow=0.6) * [width_m / 2, width_m / 2, height_m / 2] + [0.0, 0.0, height_m / 2]
    return leaves(half, 0.45, rng)


def hedge(rng: np.random.Generator, length_m: float, width_m: float, height_m: float) -> Mesh:
    """A clipped hedge along x with uneven faces, dense enough that few rays pass through."""
    count = int(60 * length_m * (height_m + width_m))
    along, across, up = rng.uniform(-0.5, 0.5, size=(3, count))
    across = np.sign(across) * np.abs(2 * across) ** 0.3 / 2  # most leaves near the two faces
    swell = 1.0 + 0.12 * np.sin(along * length_m * rng.uniform(1.0, 2.0))
    return leaves(
        np.column_stack([along * length_m, across * swell * width_m, (up * swell + 0.5) * height_m]), 0.42, rng
    )


def _ball(rng: np.random.Generator, count: int, *, hollow: float) -> np.ndarray:
    """Points within the unit ball, at least `hollow` from its centre."""
    directions = geometry.unit_rows(rng.normal(size=(count, 3)))
    return directions * (rng.uniform(hollow**3, 1.0, size=(count, 1)) ** (1 / 3))
