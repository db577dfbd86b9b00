"""Label errors as configured, in regions and at edges, and without moving classes."""

import numpy as np
import pytest

from segslam.core.types import Label
from tools.benchmarks.registration.label_errors import CONFUSED_WITH, LabelErrorConfig, network_like

NONE = LabelErrorConfig(regions=0, bleeding=0.0, lost=0.0)


def wall_and_car() -> tuple[np.ndarray, np.ndarray]:
    """A wall 10 m ahead with a car painted on its middle, seen from the origin: (n, 3) and labels."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-8, 8, 400), np.linspace(-1.5, 2.0, 60)))
    car = (np.abs(y) < 2.0) & (z < 0.0)
    points = np.column_stack([np.full(len(y), 10.0), y, z])
    return points, np.where(car, Label.CAR, Label.BUILDING).astype(np.uint8)


def test_zero_settings_change_no_label():
    points, labels = wall_and_car()
    np.testing.assert_array_equal(network_like(points, labels, config=NONE, rng=np.random.default_rng(0)), labels)


def test_moving_things_look_like_standing_ones():
    points, labels = wall_and_car()
    moving = np.where(labels == Label.CAR, Label.MOVING_CAR, labels).astype(np.uint8)
    np.testing.assert_array_equal(network_like(points, moving, config=NONE, rng=np.random.default_rng(0)), labels)


def test_the_given_share_is_lost():
    points, labels = wall_and_car()
    config = NONE.model_copy(update={"lost": 0.3})
    guessed = network_like(points, labels, config=config, rng=np.random.default_rng(0))
    assert (guessed == Label.UNLABELLED).mean() == pytest.approx(0.3, abs=0.01)  # 24,000 draws
    assert (guessed[guessed != Label.UNLABELLED] == labels[guessed != Label.UNLABELLED]).all()


def test_a_confused_region_is_one_ball_of_plausible_classes():
    points, labels = wall_and_car()
    config = NONE.model_copy(update={"regions": 1, "region_radius_m": 2.0})
    guessed = [network_like(points, labels, config=config, rng=np.random.default_rng(seed)) for seed in range(10)]
    changed = [one != labels for one in guessed]
    assert any(rows.any() for rows in changed)
    for one, rows in zip(guessed, changed, strict=True):
        for label in np.unique(labels[rows]):
            taken_for = np.unique(one[rows & (labels == label)])
            assert len(taken_for) == 1
            assert taken_for[0] in CONFUSED_WITH[Label(label)]


def test_bleeding_stays_at_the_edges():
    points, labels = wall_and_car()
    config = NONE.model_copy(update={"bleeding": 1.0})
    guessed = network_like(points, labels, config=config, rng=np.random.default_rng(0))
    wrong = guessed != labels
    assert 0.001 < wrong.mean() < 0.1
    # two pixels of the image are 0.7 degrees, some 0.12 m here, and one row of it is as little
    to_edge = np.minimum(np.abs(np.abs(points[:, 1]) - 2.0), np.abs(points[:, 2]))
    assert to_edge[wrong].max() < 0.4


def test_the_same_seed_makes_the_same_mistakes_and_no_points_none():
    points, labels = wall_and_car()
    config = LabelErrorConfig()
    first, again = (network_like(points, labels, config=config, rng=np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    empty = network_like(points[:0], labels[:0], config=config, rng=np.random.default_rng(5))
    assert len(empty) == 0
