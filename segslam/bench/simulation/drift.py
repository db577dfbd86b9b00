"""Slowly varying sensor errors, which cause odometry drift.

Each error is an Ornstein-Uhlenbeck process. Uncompensated motion within a sweep blurs the scan. A spinning head whose
axis and encoder errors vary distorts the points ahead and behind in the same way: every metre of travel then adds a
rotation error, vertical and horizontal.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from segslam.bench.simulation.world_settings import SensorConfig
from segslam.core import geometry
from segslam.core.types import Points, Tangent, Vector


@dataclass(frozen=True, slots=True, eq=False)
class SweepError:
    """Errors of one sweep; all are small."""

    motion: Tangent
    """Uncompensated motion during the whole sweep."""
    vertical_rad: float
    """Angle by which every point appears too low."""
    azimuth_rad: float
    """Azimuth error: points ahead appear too far left and points behind too far right; points abeam do not move."""


NO_ERROR = SweepError(geometry.tangent(rotation_rad=0.0, translation_m=0.0), 0.0, 0.0)


def sweep_errors(time_s: Vector, *, config: SensorConfig, rng: np.random.Generator) -> Iterator[SweepError]:
    """The errors of the sweeps at the times (n,), ascending.

    The errors of a sweep do not depend on the number of sweeps after it.
    """
    motion_rng, wander_rng = rng.spawn(2)
    still = geometry.tangent(
        rotation_rad=np.radians(config.sweep_rotation_sigma_deg), translation_m=config.sweep_translation_sigma_m
    )
    motions = still * _slow_noise(time_s, 6, config.sweep_correlation_s, motion_rng)
    wander = np.radians(config.axis_wander_sigma_deg) * _slow_noise(time_s, 2, config.axis_wander_s, wander_rng)
    for motion, (vertical, azimuth) in zip(motions, wander, strict=True):
        yield SweepError(motion, float(vertical), float(azimuth))


def _slow_noise(time_s: Vector, count: int, correlation_s: float, rng: np.random.Generator) -> np.ndarray:
    """(n, count) samples of Ornstein-Uhlenbeck processes of unit variance."""
    kept = np.exp(-np.diff(time_s, prepend=time_s[:1]) / correlation_s)
    noise = rng.normal(size=(len(time_s), count))
    for row in range(1, len(noise)):
        noise[row] = kept[row] * noise[row - 1] + np.sqrt(1.0 - kept[row] ** 2) * noise[row]
    return noise


def distorted(points: Points, sweep_fraction: Vector, error: SweepError) -> Points:
    """Points of the LiDAR frame displaced by the errors of a sweep, to first order in the errors.

    `sweep_fraction` (n,): time of each point within the sweep, from -0.5 to 0.5. The sensor's pose refers to time 0.
    """
    a, b, c = error.motion[:3]
    turned = np.einsum("ij,kj->ik", points, np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]))
    x, y, z = points.T
    flat = np.maximum(np.hypot(x, y), 1e-9)
    lowered = error.vertical_rad * np.column_stack([z * x / flat, z * y / flat, -flat])
    swung = error.azimuth_rad * (x / flat)[:, None] * np.column_stack([-y, x, np.zeros_like(z)])
    return points - sweep_fraction[:, None] * (turned + error.motion[3:]) + lowered + swung
