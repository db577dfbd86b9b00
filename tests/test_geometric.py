"""Worlds made by hand, symmetries, and real scans against their ground truth."""

import numpy as np
import pytest

from segslam.config import GeometricLabelsConfig
from segslam.semantics.geometric import geometric_labels
from segslam.types import Label

CONFIG = GeometricLabelsConfig()
SENSOR_HEIGHT_M = 1.7


def _sheet(origin, along, up, *, step_m=0.08):
    """Points of a rectangle spanned by two edges from a corner."""
    along, up = np.asarray(along, float), np.asarray(up, float)
    u = np.arange(0.0, 1.0, step_m / np.linalg.norm(along))
    v = np.arange(0.0, 1.0, step_m / np.linalg.norm(up))
    a, b = np.meshgrid(u, v)
    return np.asarray(origin, float) + a.reshape(-1, 1) * along + b.reshape(-1, 1) * up


def _world():
    """{class: points} in the LiDAR frame: a plain with a post, a box and a wall."""
    z = -SENSOR_HEIGHT_M
    ground = _sheet([-20, -20, z], [40, 0, 0], [0, 40, 0], step_m=0.2)
    post = np.vstack([_sheet([6, 4, z], [0.1, 0, 0], [0, 0, 2.5]), _sheet([6, 4, z], [0, 0.1, 0], [0, 0, 2.5])])
    box = np.vstack([_sheet([-8, 3, z], [4, 0, 0], [0, 0, 1.5]), _sheet([-4, 3, z], [0, 1.7, 0], [0, 0, 1.5])])
    wall = _sheet([-15, -12, z], [25, 0, 0], [0, 0, 5])
    return {Label.ROAD: ground, Label.POLE: post, Label.CAR: box, Label.BUILDING: wall}


def _shares(labels, truth):
    """Share of the points of each class, those above the ground, that got it."""
    return {int(label): float((labels[truth == label] == label).mean()) for label in np.unique(truth)}


def test_a_post_a_box_and_a_wall_on_a_plain_are_told_apart():
    world = _world()
    points = np.vstack(list(world.values()))
    truth = np.repeat([int(label) for label in world], [len(part) for part in world.values()])
    high = (points[:, 2] > 0.5 - SENSOR_HEIGHT_M) | (truth == Label.ROAD)  # feet of things may count as ground
    band = high & ((truth != Label.POLE) | (points[:, 2] < 2.3 - SENSOR_HEIGHT_M))
    shares = _shares(geometric_labels(points, config=CONFIG)[band], truth[band])
    assert min(shares.values()) > 0.95, shares


def test_permuting_the_points_permutes_the_labels():
    points = np.vstack(list(_world().values()))
    order = np.random.default_rng(3).permutation(len(points))
    labels = geometric_labels(points, config=CONFIG)
    np.testing.assert_array_equal(geometric_labels(points[order], config=CONFIG), labels[order])


@pytest.mark.parametrize("num_points", [0, 1, 2, 9, 50])
def test_tiny_clouds_get_labels(num_points):
    points = np.random.default_rng(num_points).normal(size=(num_points, 3)) * 5
    assert geometric_labels(points, config=CONFIG).shape == (num_points,)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_stay_unlabelled(value):
    points = np.vstack(list(_world().values()))
    broken = np.vstack([points, np.full((5, 3), value)])
    labels = geometric_labels(broken, config=CONFIG)
    assert not labels[-5:].any()
    np.testing.assert_array_equal(labels[:-5], geometric_labels(points, config=CONFIG))


def test_points_all_in_one_place_get_labels():
    assert len(geometric_labels(np.ones((1000, 3)), config=CONFIG)) == 1000
