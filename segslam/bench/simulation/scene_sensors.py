"""LiDAR sensors of several kinds: 16 to 128 beams, high or narrow fields of view, a non-repetitive pattern."""

import math

import numpy as np

from segslam.bench.simulation.scenes import Scene
from segslam.core.types import Points, Transform

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


def scan_points(
    scene: Scene, sensor: str, T_world_lidar: Transform, *, noise_m: float, rng: np.random.Generator
) -> Points:
    """One sweep (n, 3), float32, in the sensor's frame, with range noise and lost returns."""
    rays = _rays(sensor, rng)
    ranges = scene.cast(T_world_lidar, rays).range_m
    seen = (ranges > MIN_RANGE_M) & (ranges < MAX_RANGE_M) & (rng.random(len(rays)) > DROPOUT)
    ranges = ranges[seen] + rng.normal(scale=noise_m, size=int(seen.sum()))
    return (rays[seen] * ranges[:, None]).astype(np.float32)


def _rays(sensor: str, rng: np.random.Generator) -> Points:
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
