"""Residuals that a whole patch has in common: those of wrong poses, not of noise."""

import numpy as np
import pytest

from segslam.verification.patches import common_residual_m

WALL = np.array([[5.0, y, z] for y in np.arange(-6.0, 6.0, 0.3) for z in np.arange(-1.5, 1.5, 0.3)])
"""A wall across x, 5 m ahead of the sensor, in points 0.3 m apart."""
TOWARDS = np.tile([-1.0, 0.0, 0.0], (len(WALL), 1))


@pytest.mark.parametrize("noise_m", [0.01, 0.03, 0.1])
def test_noise_has_no_common_part(noise_m: float) -> None:
    noise = np.random.default_rng(0).normal(scale=noise_m, size=len(WALL))
    assert common_residual_m(WALL, TOWARDS, noise) < 0.15 * noise_m


@pytest.mark.parametrize("noise_m", [0.0, 0.03, 0.1])
def test_a_displaced_wall_shows_in_any_noise(noise_m: float) -> None:
    noise = np.random.default_rng(1).normal(scale=noise_m, size=len(WALL))
    assert common_residual_m(WALL, TOWARDS, 0.2 + noise) == pytest.approx(0.2, abs=0.02)
    recess = np.where(np.abs(WALL[:, 1]) < 1.5, 0.2, 0.0)
    share = np.mean(recess > 0)
    assert common_residual_m(WALL, TOWARDS, recess + noise) == pytest.approx(0.2 * np.sqrt(share), abs=0.02)


def test_the_signs_of_the_normals_do_not_matter() -> None:
    signs = np.random.default_rng(2).choice([-1.0, 1.0], size=len(WALL))
    found = common_residual_m(WALL, signs[:, None] * TOWARDS, signs * 0.2)
    assert found == pytest.approx(0.2)


def test_two_sides_of_a_corner_are_two_patches() -> None:
    """A scan rotated relative to a corner is in front of one wall and behind the other."""
    side = np.column_stack([WALL[:, 1] - 1.0, np.full(len(WALL), 6.0), WALL[:, 2]])
    points, normals = np.vstack([WALL, side]), np.vstack([TOWARDS, np.tile([0.0, -1.0, 0.0], (len(side), 1))])
    residuals_m = np.concatenate([np.full(len(WALL), 0.2), np.full(len(side), -0.2)])
    assert common_residual_m(points, normals, residuals_m) == pytest.approx(0.2)


def test_single_points_prove_nothing() -> None:
    few = np.arange(0, len(WALL), 37)
    assert common_residual_m(WALL[few], TOWARDS[few], np.full(len(few), 0.3)) == 0.0
    assert common_residual_m(WALL[:0], TOWARDS[:0], np.empty(0)) == 0.0
