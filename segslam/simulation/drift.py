"""What makes odometry drift: errors that change slowly from sweep to sweep and that nobody corrects.

Each is an Ornstein-Uhlenbeck process. Motion left over within a sweep smears it. A spinning head whose axis and encoder
wander distorts it equally ahead and behind, which rotates the odometry with every metre, up or down and sideways.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from segslam import geometry
from segslam.simulation.world_settings import SensorConfig
from segslam.types import Points, Tangent, Vector


@dataclass(frozen=True, slots=True, eq=False)
class SweepError:
    """The errors of one sweep, all small."""

    motion: Tangent
    """Over the whole sweep, not compensated."""
    vertical_rad: float
    """By which every point appears too low."""
    azimuth_rad: float
    """By which a point ahead appears too far left, one behind too far right, and one abeam in its place."""


NO_ERROR = SweepError(geometry.tangent(rotation_rad=0.0, translation_m=0.0), 0.0, 0.0)


def sweep_errors(time_s: Vector, *, config: SensorConfig, rng: np.random.Generator) -> Iterator[SweepError]:
    """The errors of the sweeps at these times (n,), which ascend; the first ones do not depend on how many follow."""
    motion_rng, wander_rng = rng.spawn(2)
    still = geometry.tangent(
        rotation_rad=np.radians(config.sweep_rotation_sigma_deg), translation_m=config.sweep_translation_sigma_m
    )
    motions = still * _slow_noise(time_s, 6, config.sweep_correlation_s, motion_rng)
    wander = np.radians(config.axis_wander_sigma_deg) * _slow_noise(time_s, 2, config.axis_wander_s, wander_rng)
    for motion, (vertical, azimuth) in zip(motions, wander, strict=True):
        yield SweepError(motion, float(vertical), float(azimuth))


def _slow_noise(time_s: Vector, count: int, correlation_s: float, rng: np.random.Generator) -> np.ndarray:
    """(n, count) Ornstein-Uhlenbeck processes of unit variance."""
    kept = np.exp(-np.diff(time_s, prepend=time_s[:1]) / correlation_s)
    noise = rng.normal(size=(len(time_s), count))
    for row in range(1, len(noise)):
        noise[row] = kept[row] * noise[row - 1] + np.sqrt(1.0 - kept[row] ** 2) * noise[row]
    return noise


def distorted(points: Points, sweep_fraction: Vector, error: SweepError) -> Points:
    """Points of the LiDAR frame as they come out of a sweep with errors, to first order in them.

    `sweep_fraction` (n,): time of each point within the sweep, from -0.5 to 0.5; the pose is that of its middle.
    """
    a, b, c = error.motion[:3]
    turned = np.einsum("ij,kj->ik", points, np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]))
    x, y, z = points.T
    flat = np.maximum(np.hypot(x, y), 1e-9)
    lowered = error.vertical_rad * np.column_stack([z * x / flat, z * y / flat, -flat])
    swung = error.azimuth_rad * (x / flat)[:, None] * np.column_stack([-y, x, np.zeros_like(z)])
    return points - sweep_fraction[:, None] * (turned + error.motion[3:]) + lowered + swung
