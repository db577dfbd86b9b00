"""Faces that were drawn, and each voxel's judgement against a principal component analysis."""

import numpy as np
import pytest

from segslam.core.geometry import yaw
from segslam.labels.geometric import (
    LAYER_M,
    MIN_LENGTH_M,
    NUM_LAYERS,
    WALL_CELL_M,
    WALL_MIN_POINTS,
    WALL_MIN_TOP_M,
    WALL_THICKNESS_M,
    on_walls,
)


def _face(rng, *, length_m, height_m, thickness_m=0.02, turn_deg=0.0, num_points=3000):
    points = rng.uniform([0, 0, 0], [length_m, 0, height_m], (num_points, 3))
    points[:, 1] = rng.normal(0, thickness_m, num_points)
    return points @ yaw(np.radians(turn_deg)).T + [3.0, 5.0, 0.0]


def _by_components(points, heights):
    """The rule, point by point, on the points of the 3 x 3 voxels around it."""
    cells = np.floor(points[:, :2] / WALL_CELL_M)
    layers = np.clip(heights // LAYER_M, 0, NUM_LAYERS - 1)
    walls = np.zeros(len(points), bool)
    for k in range(len(points)):
        around = (np.abs(cells - cells[k]) <= 1).all(axis=1)
        near = points[around & (layers == layers[k]), :2]
        if len(near) >= WALL_MIN_POINTS and heights[around].max() >= WALL_MIN_TOP_M:
            across, along = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(near.T, bias=True)), 0.0))
            walls[k] = across < WALL_THICKNESS_M and along > MIN_LENGTH_M
    return walls


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 45.0, 100.0])
def test_a_face_is_a_wall_however_it_is_turned(rng, turn_deg):
    points = _face(rng, length_m=8, height_m=4, turn_deg=turn_deg)
    assert on_walls(points, points[:, 2]).mean() > 0.9  # too little is seen around its two ends


def test_a_low_face_and_a_thick_bush_are_none(rng):
    for points in (_face(rng, length_m=8, height_m=1.5), _face(rng, length_m=8, height_m=4, thickness_m=0.5)):
        assert on_walls(points, points[:, 2]).mean() < 0.05


def test_each_point_agrees_with_a_component_analysis(rng):
    scatter = rng.uniform([0, 0, 0], [10, 10, 6], (300, 3))
    points = np.vstack([_face(rng, length_m=6, height_m=5, thickness_m=0.1, turn_deg=20, num_points=400), scatter])
    expected = _by_components(points, points[:, 2])
    assert 0.2 < expected.mean() < 0.8
    # coordinates count in whole millimetres: a point or two may fall on the other side of a bound
    assert (on_walls(points, points[:, 2]) != expected).mean() < 0.02


def test_permuting_the_points_permutes_the_walls(rng):
    points = _face(rng, length_m=6, height_m=5, thickness_m=0.14)
    order = rng.permutation(len(points))
    expected = on_walls(points, points[:, 2])[order]
    np.testing.assert_array_equal(on_walls(points[order], points[order, 2]), expected)


def test_no_points_lie_on_no_wall():
    assert on_walls(np.empty((0, 3)), np.empty(0)).shape == (0,)
