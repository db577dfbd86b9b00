"""Trees, bushes and hedges, with the origin on the ground."""

import numpy as np

from segslam.bench.simulation.mesh import Mesh, join_meshes, leaves, stem
from segslam.core.types import Label


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
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * (rng.uniform(hollow**3, 1.0, size=(count, 1)) ** (1 / 3))
