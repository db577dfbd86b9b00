"""Ground patches of made-up surfaces and of real scans."""

import numpy as np
import pytest
from helpers.real_scans import raw_scan

from segslam.core import geometry
from segslam.core.types import Label
from segslam.registration.segregator.describe import CELL_M, REACH_M, ground_patches

SLOPE = geometry.exp(geometry.tangent(rotation_rad=[0.1, -0.05, 0.0], translation_m=[0.0, 0.0, -1.7]))


def sloping_road(count: int = 40_000) -> np.ndarray:
    plane = np.random.default_rng(0).uniform([-50, -50, 0], [50, 50, 0], size=(count, 3))
    return geometry.apply(SLOPE, plane)


def road(count: int) -> np.ndarray:
    return np.full(count, Label.ROAD, np.uint8)


def test_patches_of_a_plane_lie_on_it_and_share_its_normal() -> None:
    points = sloping_road()
    centres, normals = ground_patches(points, road(len(points)))
    assert len(centres) == pytest.approx((2 * REACH_M / CELL_M) ** 2, abs=1)
    assert np.allclose(normals, SLOPE[:3, 2], atol=1e-3)  # the resolution is 0.1 mm over 4 m
    assert np.abs(geometry.apply(geometry.inverse(SLOPE), centres)[:, 2]).max() < 1e-3


def test_normals_point_to_the_sensor_even_from_a_ceiling() -> None:
    points = sloping_road() * [1, 1, -1]
    centres, normals = ground_patches(points, road(len(points)))
    assert np.all(np.sum(centres * normals, axis=1) < 0)


def test_only_ground_makes_patches() -> None:
    points = sloping_road()
    assert len(ground_patches(points, np.full(len(points), Label.BUILDING, np.uint8))[0]) == 0


def test_rough_cells_and_thin_rings_make_none() -> None:
    rng = np.random.default_rng(1)
    bushes = rng.uniform([4, 4, -1], [8, 8, 1], size=(500, 3))
    ring = np.column_stack([rng.uniform(4, 8, 500), np.full((500, 2), -1.0)])
    for points in (bushes, ring):
        assert len(ground_patches(points, road(500))[0]) == 0


def test_order_of_points_does_not_matter_to_the_last_bit() -> None:
    points = sloping_road()
    order = np.random.default_rng(2).permutation(len(points))
    for one, other in zip(
        ground_patches(points, road(len(points))), ground_patches(points[order], road(len(points))), strict=True
    ):
        assert np.array_equal(one, other)


def test_far_points_and_no_numbers_change_nothing() -> None:
    points = sloping_road()
    strange = np.array([[np.nan, 0, 0], [0, np.inf, 0], [1e6, 0, 0], [0, 0, -1e9]])
    more = np.concatenate([points, strange])
    for one, other in zip(
        ground_patches(points, road(len(points))), ground_patches(more, road(len(more))), strict=True
    ):
        assert np.array_equal(one, other)


def test_no_points_make_no_patches() -> None:
    centres, normals = ground_patches(np.empty((0, 3)), np.empty(0, np.uint8))
    assert centres.shape == normals.shape == (0, 3)


@pytest.mark.data
def test_the_real_road_is_below_the_sensor_and_nearly_level(data_dir) -> None:
    centres, normals = ground_patches(*raw_scan(data_dir, 0))
    near = np.linalg.norm(centres, axis=1) < 15
    assert near.sum() > 10
    assert np.median(centres[near, 2]) == pytest.approx(-1.73, abs=0.15)  # KITTI's sensor height
    assert np.median(normals[near, 2]) > 0.99
