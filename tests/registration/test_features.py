"""Key points of a scan: which points, which order, what they hold, and degenerate clouds."""

import numpy as np
import pytest
from helpers.real_scans import PREDICTED, raw_scan

from segslam.core.config import SegregatorConfig
from segslam.core.points import voxel_means
from segslam.core.types import Label
from segslam.registration.segregator.describe import MAX_CLOUD_POINTS, point_features

CONFIG = SegregatorConfig(max_features_per_class=200)
WALL = np.stack(np.meshgrid([8.0], np.arange(-5, 5, 0.11), np.arange(-1, 3, 0.13)), axis=-1).reshape(-1, 3)


def labelled(points: np.ndarray, label: Label = Label.BUILDING) -> np.ndarray:
    return np.full(len(points), label, np.uint8)


@pytest.mark.data
@pytest.mark.parametrize("scan", PREDICTED)
def test_key_points_of_a_real_scan_are_voxel_means_with_unit_descriptors(data_dir, scan: int) -> None:
    points, labels = raw_scan(data_dir, scan)
    features = point_features(points, labels, config=CONFIG)
    assert np.unique(features["feature_classes"]).tolist() == [Label.BUILDING, Label.VEGETATION]
    np.testing.assert_allclose(np.linalg.norm(features["feature_descriptors"].astype(float), axis=1), 1.0, atol=1e-3)
    assert np.linalg.eigvalsh(features["feature_covariances"]).min() > -1e-6  # float32 of patches of a square metre
    for label in (Label.BUILDING, Label.VEGETATION):
        means = voxel_means(points[labels == label], CONFIG.feature_voxel_m).astype(np.float32)
        chosen = features["feature_points"][features["feature_classes"] == label]
        assert len(chosen) == CONFIG.max_features_per_class
        assert {tuple(point) for point in chosen} <= {tuple(point) for point in means}


@pytest.mark.data
def test_the_order_of_points_changes_nothing(data_dir) -> None:
    points, labels = raw_scan(data_dir, 0)
    order = np.random.default_rng(0).permutation(len(points))
    before = point_features(points, labels, config=CONFIG)
    after = point_features(points[order], labels[order], config=CONFIG)
    for name, column in before.items():
        np.testing.assert_array_equal(column, after[name])


@pytest.mark.data
def test_points_out_of_range_or_of_no_number_change_nothing(data_dir) -> None:
    points, labels = raw_scan(data_dir, 30)
    strange = np.array([[500, 0, 0], [np.nan, 0, 0], [0, 1e20, 0], [0.1, 0, 0]], np.float32)
    before = point_features(points, labels, config=CONFIG)
    after = point_features(
        np.concatenate([points, strange]), np.concatenate([labels, labelled(strange)]), config=CONFIG
    )
    for name, column in before.items():
        np.testing.assert_array_equal(column, after[name])


def test_the_points_with_most_neighbours_are_kept() -> None:
    config = SegregatorConfig(max_features_per_class=20)
    features = point_features(WALL, labelled(WALL), config=config)
    assert len(features["feature_points"]) == 20
    edge = 5.0 - config.feature_radius_m + config.feature_voxel_m  # nearer to the wall's ends neighbours are missing
    assert np.abs(features["feature_points"][:, 1]).max() < edge + 0.2


def test_the_patch_of_a_wall_is_flat_and_round() -> None:
    features = point_features(WALL, labelled(WALL), config=CONFIG)
    middle = np.abs(features["feature_points"][:, 1]) < 3
    flat = features["feature_covariances"][middle][:, 0]
    np.testing.assert_allclose(flat, 0.0, atol=1e-6)
    spread = features["feature_covariances"][middle][:, 1, 1]
    assert np.median(spread) == pytest.approx(CONFIG.normal_radius_m**2 / 4, abs=0.04)  # a disc; 13 voxels sample it


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.full((40, 3), np.nan),
        np.array([[10.0, 0, 0]]),
        np.repeat([[10.0, 1, -1]], 50, axis=0),
        np.random.default_rng(0).uniform(-90, 90, (100, 3)),
    ],
    ids=["empty", "not a number", "single", "duplicates", "scattered"],
)
def test_clouds_without_surfaces_have_no_key_points(points: np.ndarray) -> None:
    features = point_features(points, labelled(points), config=CONFIG)
    assert features["feature_points"].shape == (0, 3)
    assert features["feature_covariances"].shape == (0, 3, 3)
    assert features["feature_descriptors"].shape == (0, 33)
    assert features["feature_points"].dtype == np.float32
    assert features["feature_descriptors"].dtype == np.float16


def test_key_points_on_a_line_are_finite() -> None:
    line = np.linspace([5.0, 5, 0], [40, 5, 0], 2000)
    features = point_features(line, labelled(line), config=SegregatorConfig(normal_radius_m=1.0))
    assert len(features["feature_points"]) > 90
    assert all(np.isfinite(column).all() for column in features.values())


@pytest.mark.long
def test_of_a_crowded_class_the_nearest_points_are_described() -> None:
    points = np.random.default_rng(0).uniform(-50, 50, (2_000_000, 3)).astype(np.float32)
    assert len(voxel_means(points, CONFIG.feature_voxel_m)) > MAX_CLOUD_POINTS
    features = point_features(points, labelled(points), config=CONFIG)
    assert len(features["feature_points"]) == CONFIG.max_features_per_class
    assert (
        np.linalg.norm(features["feature_points"], axis=1).max() < 15.0
    )  # 1.8 occupied voxels a cubic metre fill 13.8 m
