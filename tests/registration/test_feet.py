"""Upright clusters on the ground: known heights, what stays where it is, and that feet repeat where centres do not."""

import numpy as np
import pytest
from helpers.real_scans import PREDICTED, raw_scan

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.types import Description, Label
from segslam.registration.segregator import describe
from segslam.registration.segregator.clusters import MAX_RANGE_M
from segslam.registration.segregator.describe import ground_cells, stand_on_ground

UPRIGHT = SegregatorConfig().foot_classes


def slope(rng: np.random.Generator, num_points: int = 20_000) -> np.ndarray:
    x, y = rng.uniform(-30, 30, (2, num_points))
    return np.column_stack([x, y, 0.05 * x - 1.7 + rng.normal(0, 0.02, num_points)])


def cells(points: np.ndarray) -> np.ndarray:
    return ground_cells(points, np.full(len(points), Label.ROAD, np.uint8))


def clusters_at(means: np.ndarray) -> Description:
    count = len(means)
    return Description(
        means, np.tile(np.eye(3), (count, 1, 1)), np.full(count, Label.POLE, np.uint8), np.full(count, 9)
    )


def test_upright_clusters_stand_on_the_ground_beneath_and_others_stay() -> None:
    rng = np.random.default_rng(0)
    clusters = clusters_at(rng.uniform([-25, -25, 0], [25, 25, 3], (12, 3)))
    upright = np.arange(12) % 3 > 0
    standing = stand_on_ground(clusters, upright, cells(slope(rng)))
    np.testing.assert_array_equal(standing.means[:, :2], clusters.means[:, :2])
    np.testing.assert_array_equal(standing.means[~upright], clusters.means[~upright])
    expected = 0.05 * clusters.means[:, 0] - 1.7
    np.testing.assert_allclose(standing.means[upright, 2], expected[upright], atol=0.06)  # a cell's slope and noise
    np.testing.assert_array_equal(standing.covariances, clusters.covariances)


def test_one_wrong_cell_does_not_lift_a_foot() -> None:
    rng = np.random.default_rng(1)
    ground = np.concatenate([slope(rng), [[10.2, 5.1, 4.0], [10.3, 5.2, 4.1]]])
    standing = stand_on_ground(clusters_at(np.array([[10.0, 5.0, 2.0]])), np.ones(1, bool), cells(ground))
    assert standing.means[0, 2] == pytest.approx(-1.2, abs=0.06)


@pytest.mark.parametrize("ground", [np.empty((0, 3)), np.array([[40.0, 0, -1.7]])], ids=["no ground", "far ground"])
def test_clusters_without_ground_near_them_stay(ground: np.ndarray) -> None:
    clusters = clusters_at(np.array([[10.0, 5.0, 2.0]]))
    standing = stand_on_ground(clusters, np.ones(1, bool), ground)
    np.testing.assert_array_equal(standing.means, clusters.means)


def test_a_single_cell_of_ground_is_enough() -> None:
    clusters = clusters_at(np.array([[1.0, 0, 2], [0, 1, 3]]))
    standing = stand_on_ground(clusters, np.ones(2, bool), np.array([[0.0, 0, -1.5]]))
    assert standing.means[:, 2].tolist() == [-1.5, -1.5]


def test_ground_cells_are_the_means_of_a_dictionary() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform([-20, -20, -3], [20, 20, 0], (3000, 3)).astype(np.float32)
    points[:100] *= 8.0
    labels = rng.choice([Label.ROAD, Label.TERRAIN, Label.CAR, Label.UNLABELLED], 3000).astype(np.uint8)
    members: dict[tuple[float, float], list[np.ndarray]] = {}
    for point, label in zip(points.astype(float), labels, strict=True):
        if label in (Label.ROAD, Label.TERRAIN) and np.abs(point).max() < MAX_RANGE_M:
            members.setdefault(tuple(np.floor(point[:2])), []).append(point)
    expected = [np.mean(members[cell], axis=0) for cell in sorted(members)]
    np.testing.assert_allclose(ground_cells(points, labels), expected, atol=1e-9)


@pytest.mark.data
def test_the_order_of_points_and_ground_out_of_range_change_nothing(data_dir) -> None:
    points, labels = raw_scan(data_dir, 0)
    order = np.random.default_rng(0).permutation(len(points))
    strange = np.array([[np.nan, 0, 0], [0, 1e20, 0], [300, 0, 0]], np.float32)
    before = describe(points, labels, config=SegregatorConfig())
    after = describe(
        np.concatenate([strange, points[order]]),
        np.concatenate([np.full(3, Label.ROAD, np.uint8), labels[order]]),
        config=SegregatorConfig(),
    )
    np.testing.assert_array_equal(after.means, before.means)


@pytest.mark.data
def test_on_real_pairs_feet_repeat_where_centres_do_not(data_dir, real_pairs) -> None:
    def repeated(config: SegregatorConfig) -> int:
        """Upright clusters within 0.2 m of one of the same class in the other scan, over all pairs."""
        scans = {scan: describe(*raw_scan(data_dir, scan), config=config) for scan in PREDICTED}
        count = 0
        for pair in real_pairs.pairs:
            if pair.source in scans and pair.target in scans:
                source, target = scans[pair.source], scans[pair.target]
                moved = geometry.apply(pair.T_target_source, source.means)
                distance = np.linalg.norm(moved[:, None] - target.means[None], axis=2)
                alike = (source.classes[:, None] == target.classes) & np.isin(source.classes, UPRIGHT)[:, None]
                count += int(((distance < 0.2) & alike).any(axis=1).sum())
        return count

    assert repeated(SegregatorConfig()) > 1.5 * repeated(SegregatorConfig(foot_classes=()))
