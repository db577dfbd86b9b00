"""A post among columns, and the kernel against sets of occupied cells."""

import numpy as np
import pytest

from segslam.labels.geometric import (
    BAND_M,
    COLUMN_M,
    CORE,
    MIN_SHARE,
    MIN_SLICES,
    NUM_SLICES,
    RING,
    SLICE_M,
    on_thin_uprights,
)

SIDE = 60


def _found(cells, slices):
    """Of points in the middle of these cells and slices."""
    points = np.pad((np.reshape(cells, (-1, 2)) + 0.5) * COLUMN_M, ((0, 0), (0, 1)))
    return on_thin_uprights(points, BAND_M[0] + (np.asarray(slices) + 0.5) * SLICE_M)


def _post(i, j, slices):
    return [(i, j)] * len(slices), list(slices)


def _by_sets(cells, slices):
    """The same rule by sets: which slices each column, its core and its RING hold."""
    held = {}
    for cell, s in zip(map(tuple, cells), slices, strict=True):
        held.setdefault(cell, set()).add(s)
    marked = {}
    for i, j in held:
        squared = {cell: (cell[0] - i) ** 2 + (cell[1] - j) ** 2 for cell in held}
        inside = set().union(*(held[c] for c in held if squared[c] <= CORE**2))
        around = set().union(*(held[c] for c in held if CORE**2 < squared[c] <= RING**2))
        clear = inside - around
        if clear and max(clear) - min(clear) + 1 >= MIN_SLICES and len(clear) >= MIN_SHARE * len(inside):
            for cell in held:
                if squared[cell] <= CORE**2:
                    marked.setdefault(cell, set()).update(clear)
    return np.array([s in marked.get(tuple(c), ()) for c, s in zip(cells, slices, strict=True)])


def test_a_free_standing_post_is_found():
    assert _found(*_post(30, 30, range(10))).all()


def test_a_post_beside_a_wall_is_not():
    wall = [(i, 30 + RING - 2) for i in range(20, 40) for _ in range(10)]
    cells, slices = _post(30, 30, range(10))
    assert not _found(cells + wall, slices + list(range(10)) * 20).any()


def test_a_short_post_is_not():
    assert not _found(*_post(30, 30, range(5))).any()


def test_only_the_trunk_of_a_tree_is_found():
    trunk_cells, trunk_slices = _post(30, 30, range(12))
    crown = [(30 + a, 30 + b) for a in range(-6, 7) for b in range(-6, 7)]
    cells, slices = trunk_cells + crown * 3, trunk_slices + [9] * len(crown) + [10] * len(crown) + [11] * len(crown)
    found = _found(cells, slices)
    np.testing.assert_array_equal(found, np.r_[np.arange(12) < 9, np.zeros(3 * len(crown), bool)])


@pytest.mark.parametrize("seed", range(5))
def test_the_kernel_agrees_with_sets_of_cells(seed):
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, SIDE, (40, 2)).repeat(8, axis=0)
    slices = rng.integers(0, NUM_SLICES, len(cells))
    expected = _by_sets(cells, slices)
    assert expected.any()
    np.testing.assert_array_equal(_found(cells, slices), expected)


def test_points_outside_the_slices_take_no_part():
    cells, slices = _post(30, 30, range(10))
    found = _found([*cells, (30, 33), (30, 35)], [*slices, -1, NUM_SLICES])
    np.testing.assert_array_equal(found, np.arange(12) < 10)


def test_nothing_is_found_among_no_points():
    assert _found(np.empty((0, 2), np.int64), np.empty(0, np.int64)).shape == (0,)
