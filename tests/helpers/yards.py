"""A walled yard on flat ground, as a LiDAR whose beams point too low sees it."""

import numpy as np

from segslam.core import geometry

HEIGHT_M = 1.7
YARD_M = np.array([50.0, 18.0])
"""Half of its length and width."""


def seen(
    x_m: float,
    *,
    low_deg: float = 0.0,
    pitch_deg: float = 0.0,
    is_reversed: bool = False,
    seed: int = 0,
) -> np.ndarray:
    """(n, 3) what 64 beams see from a place on its middle line, with a centimetre of noise.

    The points lie too low by `low_deg`. The sensor pitches down, and looks along x, or against it.
    """
    rng = np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0.25, 360.0, 0.5)), np.radians(np.linspace(-24.0, 12.0, 64)))
    flat, upward = np.cos(elevation).ravel(), np.sin(elevation).ravel()
    beams = np.column_stack([flat * np.cos(azimuth).ravel(), flat * np.sin(azimuth).ravel(), upward])
    pitch = geometry.exp(geometry.tangent(rotation_rad=[0.0, np.radians(pitch_deg), 0.0], translation_m=0.0))
    world = beams @ pitch[:3, :3].T * ([-1.0, -1.0, 1.0] if is_reversed else 1.0)
    with np.errstate(divide="ignore"):
        to_walls = (np.sign(world[:, :2]) * YARD_M - [x_m, 0.0]) / world[:, :2]
        to_ground = np.where(world[:, 2] < 0.0, -HEIGHT_M / world[:, 2], np.inf)
    ranges = np.minimum(to_walls.min(axis=1), to_ground)
    ranges += 0.01 * rng.normal(size=len(ranges))
    lowered = elevation.ravel() - np.radians(low_deg)
    flat, upward = np.cos(lowered), np.sin(lowered)
    recorded = np.column_stack([flat * np.cos(azimuth).ravel(), flat * np.sin(azimuth).ravel(), upward])
    return ranges[:, None] * recorded
