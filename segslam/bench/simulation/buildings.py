"""Meshes of buildings with structured facades, fences, street lamps and signs."""

import numpy as np

from segslam.bench.simulation.mesh import Mesh, box, join_meshes, mesh, placed, stem
from segslam.core.types import Label, Vector

STOREYS_M = (0.0, 0.9, 2.2, 3.6, 4.9, 6.4, 7.7)  # heights of sills and lintels, alternating


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
