"""Putative correspondences: all to all, mutual neighbours, the tuple test."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.types import Description, Label
from segslam.registration.segregator import correspondences
from segslam.registration.segregator.correspondences import Correspondences, feature_pairs, mutual_nearest, tuple_test
from segslam.registration.segregator.match import putative


@pytest.fixture
def _lenient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tuple test that random features pass."""
    monkeypatch.setattr(correspondences, "TUPLE_SIMILARITY", 0.5)
    monkeypatch.setattr(correspondences, "TUPLE_TRIALS_PER_PAIR", 20)


def description(num_clusters: int, num_features: int, seed: int) -> Description:
    rng = np.random.default_rng(seed)
    return Description(
        means=rng.normal(size=(num_clusters, 3)),
        covariances=np.tile(np.eye(3), (num_clusters, 1, 1)),
        classes=rng.choice([Label.CAR, Label.TRUNK], num_clusters).astype(np.uint8),
        sizes=np.full(num_clusters, 50),
        feature_points=rng.normal(scale=20.0, size=(num_features, 3)).astype(np.float32),
        feature_covariances=np.tile(np.eye(3, dtype=np.float32), (num_features, 1, 1)),
        feature_classes=rng.choice([Label.BUILDING, Label.VEGETATION], num_features).astype(np.uint8),
        feature_descriptors=rng.uniform(0, 100, size=(num_features, 33)).astype(np.float32),
    )


def brute_mutual(source: np.ndarray, target: np.ndarray) -> set[tuple[int, int]]:
    distances = cdist(source, target)
    forth, back = distances.argmin(axis=1), distances.argmin(axis=0)
    return {(i, int(j)) for i, j in enumerate(forth) if back[j] == i}


def as_set(pairs: np.ndarray) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in pairs}


def test_every_two_clusters_of_one_class_are_paired_and_no_others() -> None:
    source = replace(description(3, 0, 0), classes=np.array([1, 16, 1], np.uint8))
    target = replace(description(4, 0, 1), classes=np.array([16, 1, 18, 1], np.uint8))
    (pairs,) = putative(source, target, config=SegregatorConfig())
    assert list(zip(pairs.source_index, pairs.target_index, strict=True)) == [(0, 1), (0, 3), (1, 0), (2, 1), (2, 3)]


@pytest.mark.parametrize("rows", [1, 7, 300, 1000])
def test_mutual_neighbours_are_those_of_the_full_distance_matrix(rows: int) -> None:
    rng = np.random.default_rng(rows)
    source, target = rng.normal(size=(rows, 33)), rng.normal(size=(200, 33))
    assert as_set(mutual_nearest(source, target)) == brute_mutual(source, target)


def test_mutual_neighbours_come_most_similar_first_and_so_in_the_same_order_from_both_sides() -> None:
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(100, 33)), rng.normal(size=(120, 33))
    forth, back = mutual_nearest(source, target), mutual_nearest(target, source)
    assert np.array_equal(forth, back[:, ::-1])
    assert np.all(np.diff(np.linalg.norm(source[forth[:, 0]] - target[forth[:, 1]], axis=1)) >= 0)


@pytest.mark.parametrize(("source", "target"), [(0, 3), (3, 0), (0, 0)])
def test_mutual_neighbours_of_nothing_are_none(source: int, target: int) -> None:
    assert mutual_nearest(np.ones((source, 33)), np.ones((target, 33))).shape == (0, 2)


def test_tuple_test_keeps_rigidly_moved_rows_and_drops_the_others() -> None:
    rng = np.random.default_rng(0)
    source = rng.uniform(-30, 30, size=(60, 3))
    target = geometry.apply(geometry.transform(geometry.yaw(1.0), [3.0, 4.0, 5.0]), source)
    target[40:] = rng.uniform(-30, 30, size=(20, 3))
    kept = tuple_test(source, target, rng=np.random.default_rng(1))
    assert set(range(40)) <= set(kept.tolist())
    # A triple with one stranger passes if two of its edges happen to agree to 5 %: a few strangers do.
    assert len(kept) < 60


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_tuple_test_has_nothing_to_test_below_three_rows(rows: int) -> None:
    points = np.arange(3.0 * rows).reshape(rows, 3)
    assert len(tuple_test(points, points, rng=np.random.default_rng(0))) == 0


def test_tuple_test_drops_rows_that_all_lie_in_one_spot() -> None:
    points = np.zeros((5, 3))
    assert len(tuple_test(points, points, rng=np.random.default_rng(0))) == 0


@pytest.mark.usefixtures("_lenient")
def test_features_never_pair_across_classes_and_are_counted_after_clusters() -> None:
    source, target = description(4, 80, 0), description(6, 90, 1)
    pairs = Correspondences.of(source, target, feature_pairs(source, target))
    i, j = pairs.source_index - 4, pairs.target_index - 6
    assert len(pairs.source) > 0
    assert np.array_equal(source.feature_classes[i], target.feature_classes[j])
    assert np.allclose(pairs.source, source.feature_points[i])
    assert np.allclose(pairs.target, target.feature_points[j])


@pytest.mark.usefixtures("_lenient")
def test_features_do_not_depend_on_which_scan_is_the_source() -> None:
    source, target = description(0, 200, 2), description(0, 200, 3)
    forth, back = feature_pairs(source, target), feature_pairs(target, source)
    assert len(forth) > 0
    assert as_set(forth) == as_set(back[:, ::-1])


@pytest.mark.usefixtures("_lenient")
def test_key_points_without_neighbours_are_not_paired() -> None:
    blank = replace(description(0, 30, 6), feature_descriptors=np.zeros((30, 33), np.float32))
    assert len(feature_pairs(blank, blank)) == 0


def test_scans_without_features_have_none_in_common() -> None:
    assert len(feature_pairs(description(3, 0, 0), description(3, 50, 1))) == 0


@pytest.mark.usefixtures("_lenient")
def test_features_are_tried_together_with_all_clusters() -> None:
    source, target = description(5, 60, 4), description(5, 60, 5)
    clusters, both = putative(source, target, config=SegregatorConfig())
    assert len(both.source) == len(clusters.source) + len(feature_pairs(source, target))
    assert np.array_equal(both.source[: len(clusters.source)], clusters.source)
    assert np.array_equal(both.target_index[: len(clusters.source)], clusters.target_index)


@pytest.mark.data
@pytest.mark.parametrize("name", ["building", "veg"])
def test_mutual_neighbours_of_real_descriptors_are_those_of_the_authors_program(data_dir: Path, name: str) -> None:
    golden = np.load(data_dir / "golden" / "000000_004413_asis.npz")
    source, target = golden[f"{name}_src_fpfh"], golden[f"{name}_tgt_fpfh"]
    ours, theirs = as_set(mutual_nearest(source, target)), as_set(golden[f"{name}_mutual"].astype(int))
    different = np.array(list(ours ^ theirs))
    assert np.array_equal(source[different[:, 0]], target[different[:, 1]])  # equal descriptors: any twin is nearest
    assert len(ours & theirs) > 200
