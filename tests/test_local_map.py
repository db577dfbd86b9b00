import numpy as np
import pytest
from kiss_icp.config.config import DataConfig, MappingConfig
from kiss_icp.config.parser import KISSConfig
from kiss_icp.mapping import VoxelHashMap, get_voxel_hash_map

from segslam import geometry
from segslam.odometry.local_map import EMPTY, LocalMap, nearest

VOXEL_M, RANGE_M, MOST = 0.8, 25.0, 6


def _map() -> LocalMap:
    return LocalMap(voxel_m=VOXEL_M, max_range_m=RANGE_M, max_points_per_voxel=MOST)


def _kiss_map() -> VoxelHashMap:
    mapping = MappingConfig(voxel_size=VOXEL_M, max_points_per_voxel=MOST)
    return get_voxel_hash_map(KISSConfig(data=DataConfig(max_range=RANGE_M), mapping=mapping))


def _points(local: LocalMap) -> np.ndarray:
    voxels, n = local.voxels, local.num_voxels
    return np.concatenate([voxels.points[row, : voxels.counts[row]] for row in range(n)])


def _sorted(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T)]


def _pose(step: int) -> np.ndarray:
    return geometry.transform(geometry.yaw(0.2 * step), [7.0 * step, -3.0 * step, 0.1 * step])


def _nearest_by_brute_force(points: np.ndarray, query: np.ndarray) -> tuple[np.ndarray, float]:
    """Of the points in the 27 voxels around."""
    near = (np.abs(np.floor(points / VOXEL_M) - np.floor(query / VOXEL_M)) <= 1).all(axis=1)
    squared = ((points[near] - query) ** 2).sum(axis=1)
    return points[near][squared.argmin()], float(squared.min())


def test_it_keeps_what_kiss_icp_s_map_keeps_point_for_point() -> None:
    """On a drive that leaves its first scans behind, with negative coordinates, crowded voxels, and growth."""
    ours, theirs = _map(), _kiss_map()
    rng = np.random.default_rng(0)
    for step in range(9):
        scan = rng.uniform(-1.0, 1.0, (6_000, 3)) * [20.0, 20.0, 2.0]
        ours.update(scan, _pose(step))
        theirs.update(scan, _pose(step))
        assert len(ours) == len(theirs.point_cloud())
        np.testing.assert_allclose(_sorted(_points(ours)), _sorted(theirs.point_cloud()), atol=1e-12)
    assert ours.voxels.counts[: ours.num_voxels].max() == MOST
    assert np.linalg.norm(_points(ours) - _pose(8)[:3, 3], axis=1).min() < RANGE_M < np.linalg.norm(_pose(8)[:3, 3])


def test_the_nearest_is_that_of_brute_force() -> None:
    local = _map()
    rng = np.random.default_rng(1)
    local.update(rng.uniform(-6.0, 6.0, (2_500, 3)), np.eye(4))
    points, places = _points(local), local.voxels.points
    for query in rng.uniform(-5.0, 5.0, (300, 3)):
        row, place, squared = nearest(local.voxels, VOXEL_M, *query, np.inf)
        expected, least = _nearest_by_brute_force(points, query)
        np.testing.assert_array_equal(places[row, place], expected)
        assert squared == pytest.approx(least, rel=1e-12)


def test_nothing_is_nearer_than_the_nearest() -> None:
    local = _map()
    local.update(np.array([[0.5, 0.5, 0.5]]), np.eye(4))
    assert nearest(local.voxels, VOXEL_M, 0.5, 0.5, 0.2, 0.09 + 1e-9)[0] == 0
    assert nearest(local.voxels, VOXEL_M, 0.5, 0.5, 0.2, 0.09 - 1e-9)[0] == EMPTY
    assert nearest(local.voxels, VOXEL_M, 5.0, 0.5, 0.5, np.inf)[0] == EMPTY, "two voxels away"


def test_a_voxel_of_a_place_left_and_seen_again_begins_anew() -> None:
    local = _map()
    first, other = np.array([[0.3, 0.3, 0.3]]), np.array([[0.4, 0.3, 0.3]])
    local.update(first, np.eye(4))
    local.update(other - [100.0, 0.0, 0.0], geometry.transform(np.eye(3), [100.0, 0.0, 0.0]))
    assert len(local) == 0, "the first is out of range, and so is what was seen from there"
    local.update(other, np.eye(4))
    np.testing.assert_array_equal(_points(local), other)
