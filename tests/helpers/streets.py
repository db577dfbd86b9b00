"""Points sampled from a generated street corner for tests of registration: walls with bays, ground, posts."""

import numpy as np

from segslam.core import geometry


def corner(rng: np.random.Generator, *, num_points: int = 20_000) -> np.ndarray:
    """(n, 3): some 60 x 60 m around the origin, 1.7 m above the ground, points spread evenly over the surfaces."""
    quarter = num_points // 4
    ground = np.column_stack([rng.uniform(-30, 30, (quarter, 2)), np.full(quarter, -1.7)])
    along, height = rng.uniform(-30, 30, quarter), rng.uniform(-1.7, 6, quarter)
    bays = 10 + 1.5 * (np.floor(along / 4.3) % 2)
    wall = np.column_stack([along, bays, height])
    side_along, side_height = rng.uniform(-30, 9, quarter), rng.uniform(-1.7, 4, quarter)
    side = np.column_stack([18 + np.floor(side_along / 6.1) % 2, side_along, side_height])
    where = rng.permutation(np.array([[-20, -8], [-11, -6], [-3, -9], [4, -5], [12, -7], [7, 6], [-9, 5], [-24, 4]]))
    turn, post = rng.uniform(0, 2 * np.pi, quarter), rng.integers(0, len(where), quarter)
    posts = np.column_stack(
        [where[post] + 0.15 * np.column_stack([np.cos(turn), np.sin(turn)]), rng.uniform(-1.7, 3, quarter)]
    )
    return np.concatenate([ground, wall, side, posts])


def small_move(rng: np.random.Generator, *, rotation_deg: float, translation_m: float) -> np.ndarray:
    """A random rigid transform of about this size."""
    return geometry.exp(
        geometry.tangent(
            rotation_rad=rng.normal(0, np.radians(rotation_deg), 3), translation_m=rng.normal(0, translation_m, 3)
        )
    )
