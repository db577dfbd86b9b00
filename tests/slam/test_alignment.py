"""Submaps of a yard."""

import gc
import weakref

import numpy as np
import pytest
from helpers.yards import seen

from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.registration.refinement import LightSurface
from segslam.slam.adjustment.alignment import _normal_equations, align
from segslam.slam.adjustment.submaps import members, surfaces_of

WAY_M = 12.0


def submap(x_m: float, *, low_deg: float = 0.0, pitch_deg: float = 0.0, seed: int = 0) -> LightSurface:
    """One scan."""
    points = seen(x_m, low_deg=low_deg, pitch_deg=pitch_deg, seed=seed).astype(np.float32)
    return surfaces_of(lambda _: points, np.eye(4)[None], np.zeros(1), config=RefineConfig())(0)


def guess() -> np.ndarray:
    return geometry.transform(np.eye(3), [WAY_M + 0.2, 0.1, 0.05])


def test_a_pitch_is_found() -> None:
    found = align(submap(WAY_M / 2, pitch_deg=0.2, seed=1), submap(-WAY_M / 2), guess())
    assert found is not None
    assert np.degrees(geometry.log(found.T_target_source)[1]) == pytest.approx(0.2, abs=0.02)
    np.testing.assert_allclose(found.T_target_source[:3, 3], [WAY_M, 0.0, 0.0], atol=0.02)


def test_the_pose_of_low_beams_is_pitched() -> None:
    found = align(submap(WAY_M / 2, low_deg=0.2, seed=1), submap(-WAY_M / 2, low_deg=0.2), guess())
    assert found is not None
    assert abs(np.degrees(geometry.log(found.T_target_source)[1])) > 0.05


def test_swapped_submaps_have_the_inverse_pose() -> None:
    source, target = submap(WAY_M / 2, seed=1), submap(-WAY_M / 2)
    forwards, backwards = align(source, target, guess()), align(target, source, geometry.inverse(guess()))
    assert forwards is not None
    assert backwards is not None
    np.testing.assert_allclose(forwards.T_target_source @ backwards.T_target_source, np.eye(4), atol=0.01)


def test_submaps_that_share_nothing_are_not_aligned() -> None:
    far = geometry.transform(np.eye(3), [200.0, 0.0, 0.0])
    assert align(submap(0.0), submap(0.0, seed=1), far) is None


def test_the_gradient_is_the_derivative_of_the_cost() -> None:
    rng = np.random.default_rng(0)
    source, target = rng.normal(scale=5.0, size=(2, 40, 3))
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    width = 1e3  # nearly least squares

    def system(xi: np.ndarray) -> tuple:
        T = np.ascontiguousarray(geometry.exp(xi))
        return _normal_equations(source, normals @ T[:3, :3], target, normals, T, width)

    _, gradient, *_ = system(np.zeros(6))
    steps = 1e-6 * np.eye(6)
    numeric = [(system(step)[2] - system(-step)[2]) / 4e-6 for step in steps]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())


def test_a_submap_ends_at_motions_that_are_not_known_to_a_voxel() -> None:
    motion_variance = np.array([0.0, 0.2, 0.1, 900.0, 0.2])
    assert members(2, motion_variance, most_m=0.6) == [0, 1, 2]
    assert members(3, motion_variance, most_m=0.6) == [3, 4]
    assert members(0, motion_variance, most_m=0.5) == [0, 1], "0.2 and 0.1 are more than 0.25"


def test_submaps_are_freed_at_once_with_the_function_that_returns_them() -> None:
    points = seen(0.0).astype(np.float32)
    gc.disable()
    try:
        submap_of = surfaces_of(lambda _: points, np.eye(4)[None], np.zeros(1), config=RefineConfig())
        kept = weakref.ref(submap_of(0))
        assert kept() is submap_of(0)
        del submap_of
        assert kept() is None
    finally:
        gc.enable()


def test_points_on_the_borders_of_voxels_are_in_the_same_ones_for_poses_that_differ_by_rounding() -> None:
    rng = np.random.default_rng(0)
    points = (rng.integers(-40, 40, (2000, 3)) * RefineConfig().voxel_m).astype(np.float32)
    turned = geometry.transform(geometry.yaw(1.0), [2.0, 3.0, 0.1])

    def made(*, moved_m: float) -> np.ndarray:
        T_world = np.array([turned, turned @ geometry.transform(np.eye(3), [1.03, 0.02, 0.01])])
        T_world[:, :3, 3] += moved_m
        return surfaces_of(lambda _: points, T_world, np.zeros(2), config=RefineConfig())(0).points

    np.testing.assert_allclose(made(moved_m=1e-13), made(moved_m=0.0), atol=1e-9)


def test_the_information_of_surfaces_without_any_noise_is_finite() -> None:
    level = np.stack(np.meshgrid(np.arange(-8.0, 8.0, 0.25), np.arange(-8.0, 8.0, 0.25), [0.0]), axis=-1).reshape(-1, 3)
    surface = surfaces_of(lambda _: level.astype(np.float32), np.eye(4)[None], np.zeros(1), config=RefineConfig())(0)
    found = align(surface, surface, np.eye(4))
    assert found is not None
    assert np.isfinite(found.information).all()
