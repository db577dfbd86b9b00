"""FPFH against the Point Cloud Library's on real scans, a plain twin, and its symmetries."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from segslam.core import geometry
from segslam.core.points import normals, patch_covariances, radius_neighbours
from segslam.registration.segregator.fpfh import fpfh, neighbour_histograms, simple_histograms

RADIUS_M = 2.5


def surface(seed: int, num_points: int = 150) -> tuple[np.ndarray, np.ndarray]:
    """Points of a wavy wall with unit normals that are not quite right, as estimated ones are."""
    rng = np.random.default_rng(seed)
    y, z = rng.uniform(-4, 4, (2, num_points))
    points = np.column_stack([12 + np.sin(y), y, z])
    directions = np.column_stack([-np.ones(num_points), np.cos(y), np.zeros(num_points)])
    directions += rng.normal(0, 0.2, directions.shape)
    return points, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def plain_angles(p: np.ndarray, n: np.ndarray, q: np.ndarray, m: np.ndarray) -> tuple[float, float, float]:
    """theta, alpha, phi of two points, each scaled to 0..1."""
    d = (q - p) / np.linalg.norm(q - p)
    if abs(n @ d) < abs(m @ d):
        return plain_angles(q, m, p, n)
    v = np.cross(d, n) / np.linalg.norm(np.cross(d, n))
    theta = np.arctan2(np.cross(n, v) @ m, n @ m)
    return theta / (2 * np.pi) + 0.5, (v @ m + 1) / 2, (n @ d + 1) / 2


def plain_fpfh(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    neighbours = cKDTree(points).query_ball_point(points, RADIUS_M)
    simple = np.zeros((len(points), 3, 11))
    for row, others in enumerate(neighbours):
        for other in set(others) - {row}:
            for angle, value in enumerate(plain_angles(points[row], directions[row], points[other], directions[other])):
                simple[row, angle, min(int(11 * value), 10)] += 100 / (len(others) - 1)
    total = simple.copy()
    for row, others in enumerate(neighbours):
        weighted = sum(simple[j] / np.sum((points[j] - points[row]) ** 2) for j in others if j != row)
        total[row] += 100 * weighted / np.sum(weighted, axis=1, keepdims=True)
    return total.reshape(-1, 33)


@pytest.mark.parametrize("seed", range(3))
def test_fpfh_is_that_of_the_plain_formulas(seed: int) -> None:
    points, directions = surface(seed)
    chosen = np.arange(0, len(points), 4)
    found = fpfh(points, directions, radius_neighbours(points, RADIUS_M), chosen)
    np.testing.assert_allclose(found, plain_fpfh(points, directions)[chosen], atol=1e-9)


def test_fpfh_does_not_change_with_the_frame() -> None:
    points, directions = surface(7)
    T = geometry.transform(geometry.yaw(1.1), [5.0, -3.0, 2.0])
    moved = geometry.apply(T, points)
    rows = np.arange(len(points))
    before = fpfh(points, directions, radius_neighbours(points, RADIUS_M), rows)
    after = fpfh(moved, directions @ T[:3, :3].T, radius_neighbours(moved, RADIUS_M), rows)
    np.testing.assert_allclose(after, before, atol=1e-6)  # rounding may move no value over the border of a bin here


def test_each_angle_has_a_whole_histogram_and_lonely_points_none() -> None:
    points, directions = surface(2)
    points = np.concatenate([points, [[-50.0, 0, 0]]])
    directions = np.concatenate([directions, [[1.0, 0, 0]]])
    rows = np.arange(len(points))
    sums = fpfh(points, directions, radius_neighbours(points, RADIUS_M), rows).reshape(-1, 3, 11).sum(axis=2)
    np.testing.assert_allclose(sums[:-1], 200.0)
    np.testing.assert_array_equal(sums[-1], 0.0)


def test_a_line_along_its_normals_has_the_middle_bin() -> None:
    points = np.column_stack([np.arange(5.0, 9.0), np.zeros(4), np.zeros(4)])
    directions = np.tile([-1.0, 0, 0], (4, 1))
    rows = np.arange(4)
    found = fpfh(points, directions, radius_neighbours(points, RADIUS_M), rows)
    np.testing.assert_allclose(found[:, [5, 16, 27]], 200.0)


@pytest.mark.data
@pytest.mark.parametrize("cloud", ["building_src", "building_tgt", "veg_src", "veg_tgt"])
def test_neighbour_histograms_are_those_of_the_point_cloud_library(data_dir, cloud: str) -> None:
    """PCL's FPFH leaves out a point's own histogram. Compared where neighbours are many, as they are at key points.

    Elsewhere three or four neighbours make a poor normal, and one of them in or out changes it.
    """
    with np.load(data_dir / "golden" / "000000_004413_asis.npz") as arrays:
        points, theirs = arrays[f"{cloud}_vox"].astype(float), arrays[f"{cloud}_fpfh"]
    covariances = patch_covariances(points, *radius_neighbours(points, 1.0))
    around = radius_neighbours(points, RADIUS_M)
    simple = simple_histograms(points, normals(points, covariances), *around, np.ones(len(points), bool))
    chosen = np.argsort(around.starts - around.ends, kind="stable")[:500]
    ours = neighbour_histograms(points, simple, *around, chosen)
    difference = np.abs(ours - theirs[chosen]).max(axis=1)  # of 100 in a histogram
    assert np.median(difference) < 0.05
    assert np.mean(difference < 2.5) > 0.95
