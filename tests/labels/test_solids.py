"""Pieces against SciPy's labelling, sides of rectangles that were drawn."""

import numpy as np
import pytest
from scipy import ndimage

from segslam.core.geometry import yaw
from segslam.labels.geometric import CELL_M, NO_PIECE, Pieces


def _rectangle(length_m, width_m, *, turn_deg, centre=(0.0, 0.0)):
    """The outline of a rectangle, every 5 cm, at height 1 m."""
    u, v = np.arange(0, length_m, 0.05) - length_m / 2, np.arange(0, width_m, 0.05) - width_m / 2
    sides = [(u, -width_m / 2), (u, width_m / 2), (-length_m / 2, v), (length_m / 2, v)]
    outline = np.vstack([np.column_stack(np.broadcast_arrays(x, y, 1.0)) for x, y in sides])
    return outline @ yaw(np.radians(turn_deg)).T + [*centre, 0.0]


def _all(points):
    return Pieces(points, points[:, 2], np.full(len(points), True))


@pytest.mark.parametrize("seed", range(3))
def test_pieces_agree_with_scipy(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-6, 6, (350, 3))
    found = _all(points)
    cells = np.floor(points[:, :2] / CELL_M).astype(int)
    cells -= cells.min(axis=0)
    image = np.zeros(cells.max(axis=0) + 1, bool)
    image[tuple(cells.T)] = True
    numbered, count = ndimage.label(image, np.ones((3, 3)))
    expected = numbered[tuple(cells.T)] - 1
    assert len(found.num_points) == count
    assert len({*zip(found.of_point, expected, strict=True)}) == count  # the same parts under other numbers
    np.testing.assert_array_equal(found.num_points, np.bincount(found.of_point))
    np.testing.assert_array_equal(found.top_m, ndimage.maximum(points[:, 2], found.of_point, np.arange(count)))


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 45.0, 71.0])
def test_the_sides_of_a_box_are_measured_however_it_is_turned(turn_deg):
    found = _all(_rectangle(4.2, 1.7, turn_deg=turn_deg))
    assert len(found.num_points) == 1
    # the nearest of the directions tried is 2.5 degrees off at most, and 4.2 m * sin(2.5 degrees) = 0.18 m
    np.testing.assert_allclose([found.length_m[0], found.width_m[0]], [4.2, 1.7], atol=0.2)


def test_boxes_a_metre_apart_are_two_pieces():
    found = _all(np.vstack([_rectangle(4, 2, turn_deg=0), _rectangle(4, 2, turn_deg=0, centre=(0, 3))]))
    assert len(found.num_points) == 2


def test_points_that_were_not_chosen_join_nothing_but_learn_where_they_stand():
    points = np.vstack([_rectangle(2, 1, turn_deg=0), [[1.0, 0.5, 0.2], [5.0, 5.0, 0.2]]])
    chosen = np.arange(len(points)) < len(points) - 2
    found = Pieces(points, points[:, 2], chosen)
    assert found.num_points == [len(points) - 2]
    np.testing.assert_array_equal(found.of_point[-2:], [0, NO_PIECE])
    assert found.top_m == [1.0]


def test_no_points_make_no_pieces():
    found = _all(np.empty((0, 3)))
    assert len(found.of_point) == len(found.num_points) == len(found.length_m) == 0
