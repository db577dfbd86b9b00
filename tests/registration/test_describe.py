"""Descriptions of whole scans: when features are made, size, symmetries, bad input."""

import dataclasses
from importlib import import_module

import numpy as np
import pytest
from helpers.real_scans import PREDICTED, raw_scan

from segslam.core.config import SegregatorConfig
from segslam.core.types import Description, Label
from segslam.registration.segregator import describe

ALWAYS = SegregatorConfig(features="always")


def num_bytes(description: Description) -> int:
    return sum(getattr(description, field.name).nbytes for field in dataclasses.fields(description))


@pytest.mark.data
@pytest.mark.parametrize("scan", PREDICTED)
def test_a_description_takes_at_most_200_kilobytes(data_dir, scan: int) -> None:
    description = describe(*raw_scan(data_dir, scan), config=ALWAYS)
    assert len(description.feature_points) == 2 * ALWAYS.max_features_per_class
    assert num_bytes(description) <= 200_000


@pytest.mark.data
def test_features_are_made_when_clusters_are_few_and_never_when_not_wanted(data_dir, monkeypatch) -> None:
    points, labels = raw_scan(data_dir, 0)
    enough = describe(points, labels, config=SegregatorConfig())
    monkeypatch.setattr(
        import_module("segslam.registration.segregator.describe"), "FEW_CLUSTERS", len(enough.sizes) + 1
    )
    few = describe(points, labels, config=SegregatorConfig())
    never = describe(points, labels, config=SegregatorConfig(features="never"))
    assert len(enough.feature_points) == 0
    assert len(few.feature_points) > 0
    assert len(never.feature_points) == 0
    np.testing.assert_array_equal(few.means, never.means)


@pytest.mark.data
def test_float32_and_float64_points_have_the_same_description(data_dir) -> None:
    points, labels = raw_scan(data_dir, 20)
    single, double = (describe(points.astype(kind), labels, config=ALWAYS) for kind in (np.float32, np.float64))
    for field in dataclasses.fields(single):
        np.testing.assert_array_equal(getattr(single, field.name), getattr(double, field.name))


def test_moving_things_and_unlabelled_points_are_left_out() -> None:
    points = np.random.default_rng(0).normal([10, 0, 0], 0.3, (500, 3))
    for label in (Label.UNLABELLED, Label.MOVING_CAR, Label.MOVING_TRUCK, Label.MOVING_PERSON):
        description = describe(points, np.full(500, label, np.uint8), config=ALWAYS)
        assert len(description.means) == 0
        assert len(description.feature_points) == 0


def test_a_scan_without_points_has_an_empty_description() -> None:
    description = describe(np.empty((0, 3)), np.empty(0, np.uint8), config=ALWAYS)
    assert description.means.shape == (0, 3)
    assert description.feature_descriptors.shape == (0, 33)


def test_labels_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="10 points but 9 labels"):
        describe(np.ones((10, 3)), np.zeros(9, np.uint8), config=ALWAYS)


@pytest.mark.parametrize("points", [np.ones((4, 2)), np.ones((4, 4)), np.ones(4)])
def test_points_of_another_shape_are_refused(points: np.ndarray) -> None:
    with pytest.raises((ValueError, TypeError)):  # a TypeError is that of the shape check while testing
        describe(points, np.ones(len(points), np.uint8), config=ALWAYS)


@pytest.mark.parametrize("seed", range(60))
def test_strange_clouds_have_finite_descriptions(seed: int) -> None:
    """Any number and scale of points; flat, on a grid or repeated; with values that are none or too large."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3, 3)
    points = rng.normal(size=(rng.choice([1, 2, 5, 100, 1000]), 3)) * scale
    points *= rng.choice([0.0, 1.0], 3, p=[0.2, 0.8])
    points = np.round(points / scale) * scale if seed % 3 == 0 else points
    points = np.repeat(points[: len(points) // 10 + 1], 10, axis=0) if seed % 5 == 0 else points
    for value in (np.nan, np.inf, -np.inf, 1e30, 1e-300):
        points[rng.integers(len(points)), rng.integers(3)] = value
    labels = (
        rng.integers(0, 26, len(points)).astype(np.uint8) if seed % 2 else np.full(len(points), Label.CAR, np.uint8)
    )
    description = describe(points.astype(np.float32 if seed % 4 < 2 else np.float64), labels, config=ALWAYS)
    for field in dataclasses.fields(description):
        assert np.isfinite(getattr(description, field.name)).all()
