"""Parts of the scenes of `scene_models`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d

from segslam.bench.simulation.mesh import Mesh, join_meshes, leaves, mesh, placed
from segslam.bench.simulation.world import scene_of
from segslam.core.types import Label


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A static scene. `path` (n, 4): positions (m) and headings (rad) of a sensor driven through it."""

    mesh: Mesh
    path: np.ndarray
    max_shift_m: float
    """Largest distance between two scans that still show the same objects."""
    rays: o3d.t.geometry.RaycastingScene
    """That of `mesh`."""


def scene_of_parts(parts: Sequence[Mesh], path: np.ndarray, max_shift_m: float) -> Scene:
    """The scene that these parts make together; its fields as in `Scene`."""
    whole = join_meshes(parts)
    return Scene(whole, path, max_shift_m, scene_of(whole))


def path_along(x: np.ndarray, y: np.ndarray, z: float, heading: np.ndarray | float) -> np.ndarray:
    """Rows (n, 4) of a path at one height: positions (m) and headings (rad)."""
    return np.column_stack([x, y, np.full_like(x, z), np.broadcast_to(heading, x.shape)])


def slab(x0: float, x1: float, y0: float, y1: float, z: float, label: Label = Label.BUILDING) -> Mesh:
    """A level rectangle between two x and two y, at the height `z` (m)."""
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    return mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), label)


def wall(line: Sequence[tuple[float, float]], height_m: float) -> Mesh:
    """A vertical wall along a line, from the ground up."""
    count = len(line)
    flat = np.column_stack([np.array(line), np.zeros(count)])
    here = np.arange(count - 1)
    sides = np.concatenate(
        [np.column_stack([here, here + 1, here + 1 + count]), np.column_stack([here, here + 1 + count, here + count])]
    )
    return mesh(np.concatenate([flat, flat + np.array([0.0, 0.0, height_m])]), sides, Label.BUILDING)


def lifted(part: Mesh, z: float) -> Mesh:
    """The part, `z` (m) higher."""
    return placed(part, 0.0, 0.0, z)


def uneven_ground(rng: np.random.Generator, size: float, step: float) -> Mesh:
    """Ground with bumps of about 10 cm and tufts of grass."""
    side = np.arange(-20.0, size + 20.0, step)
    x, y = np.meshgrid(side, side, indexing="ij")
    z = 0.12 * np.sin(x / 3.1) * np.cos(y / 4.3) + rng.normal(scale=0.04, size=x.shape)
    row, column = (index.ravel() for index in np.meshgrid(*(np.arange(len(side) - 1),) * 2, indexing="ij"))
    at = row * len(side) + column
    triangles = np.concatenate(
        [np.column_stack([at, at + len(side), at + 1]), np.column_stack([at + 1, at + len(side), at + len(side) + 1])]
    )
    tufts = np.column_stack([rng.uniform(0.0, size, (2500, 2)), rng.uniform(0.05, 0.35, 2500)])
    return join_meshes(
        [mesh(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), triangles, Label.TERRAIN), leaves(tufts, 0.3, rng)]
    )
