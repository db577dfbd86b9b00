"""Labelled triangle meshes and the solids that streets are built of. Units are metres; z is up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from segslam.core.types import Label, Labels

Triangles = Int[np.ndarray, "_ 3"]
Instances = UInt16[np.ndarray, "_"]
"""Numbers of the object instances; 0 for none."""
Flags = Bool[np.ndarray, "_"]
Polygon = Float[np.ndarray, "_ 2"]
BOX_SIDES = np.array(
    [[0, 1, 5], [0, 5, 4], [1, 3, 7], [1, 7, 5], [3, 2, 6], [3, 6, 7], [2, 0, 4], [2, 4, 6], [4, 5, 7], [4, 7, 6]]
)


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles, each with a class, an instance (0: none) and a flag for glass. Both sides of a triangle reflect."""

    vertices: Float[np.ndarray, "_ 3"]
    triangles: Triangles
    labels: Labels
    instances: Instances
    glass: Flags


def mesh(vertices: np.ndarray, triangles: np.ndarray, label: Label, *, glass: bool = False) -> Mesh:
    """A mesh with one class and no instance."""
    count = len(triangles)
    return Mesh(
        np.asarray(vertices, dtype=np.float64),
        np.asarray(triangles, dtype=np.int64).reshape(-1, 3),
        np.full(count, label, dtype=np.uint8),
        np.zeros(count, dtype=np.uint16),
        np.full(count, glass),
    )


def join_meshes(parts: Sequence[Mesh]) -> Mesh:
    """All parts as one mesh; an empty mesh if there are no parts."""
    if not parts:
        return mesh(np.empty((0, 3)), np.empty((0, 3)), Label.UNLABELLED)
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.labels for part in parts]),
        np.concatenate([part.instances for part in parts]),
        np.concatenate([part.glass for part in parts]),
    )


def placed(part: Mesh, x: float, y: float, z: float, *, yaw_rad: float = 0.0) -> Mesh:
    """The mesh rotated about z, then translated."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turned = part.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return replace(part, vertices=turned + np.array([x, y, z]))


def as_instance(part: Mesh, number: int, *, only: Sequence[Label] = tuple(Label)) -> Mesh:
    """The mesh with an instance number, wrapped to 1-65535, on its triangles of the given classes."""
    instance = (number - 1) % 65535 + 1
    return replace(part, instances=np.where(np.isin(part.labels, only), instance, 0).astype(np.uint16))


def box(
    length: float, width: float, z0: float, z1: float, label: Label, *, at: tuple[float, float] = (0.0, 0.0)
) -> Mesh:
    """A box without bottom face, `length` along x and `width` along y, centred on `at`."""
    return frustum((length, width, 0.0), (length, width, 0.0), z0, z1, label, at=at)


def frustum(
    bottom: tuple[float, float, float],
    top: tuple[float, float, float],
    z0: float,
    z1: float,
    label: Label,
    *,
    at: tuple[float, float] = (0.0, 0.0),
    glass: bool = False,
) -> Mesh:
    """A frustum between two rectangles (length, width, shift along x), with walls and a top face."""
    rows = [
        (at[0] + shift + sx * length / 2, at[1] + sy * width / 2, z)
        for (length, width, shift), z in ((bottom, z0), (top, z1))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return mesh(np.array(rows), BOX_SIDES, label, glass=glass)


def extruded(profile_xz: Polygon, width: float, label: Label) -> Mesh:
    """A convex profile in x and z, extruded to `width` along y, with closed ends."""
    count = len(profile_xz)
    near = np.column_stack([profile_xz[:, 0], np.full(count, -width / 2), profile_xz[:, 1]])
    far = near * [1.0, -1.0, 1.0]
    fan = np.column_stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)])
    return mesh(np.concatenate([near, far]), np.concatenate([fan, fan + count, band(count, count)]), label)


def band(count: int, offset: int) -> Triangles:
    """Triangles between a closed ring of `count` vertices and the ring that starts `offset` later."""
    here = np.arange(count)
    after = (here + 1) % count
    return np.concatenate(
        [np.column_stack([here, after, after + offset]), np.column_stack([here, after + offset, here + offset])]
    )


def stem(
    radii_m: Sequence[float], heights_m: Sequence[float], label: Label, *, lean: float = 0.0, sides: int = 8
) -> Mesh:
    """A vertical round stem with a radius at each height. `lean`: shift of x for each metre of height."""
    angles = np.arange(sides) * (2 * np.pi / sides)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
    rings = [circle * r + [lean * h, 0.0, h] for r, h in zip(radii_m, heights_m, strict=True)]
    bands = [band(sides, sides) + ring * sides for ring in range(len(rings) - 1)]
    return mesh(np.concatenate(rings), np.concatenate(bands), label)


def leaves(centres: np.ndarray, size_m: float, rng: np.random.Generator) -> Mesh:
    """A randomly oriented triangle of about `size_m` around each centre; simulates foliage."""
    corners = rng.normal(scale=size_m / 2, size=(len(centres), 3, 3))
    vertices = (centres[:, None] + corners - corners.mean(axis=1, keepdims=True)).reshape(-1, 3)
    return mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), Label.VEGETATION)
