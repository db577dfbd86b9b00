"""Voxels, neighbours, patches, normals: against SciPy and NumPy, at the borders of cells, and for bad input."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from segslam.core.points import (
    canonical_order,
    first_rows,
    group_means,
    normals,
    patch_covariances,
    patch_normals,
    radius_neighbours,
    voxel_first,
    voxel_means,
    within_range,
)


def cloud(seed: int, num_points: int = 400, extent_m: float = 6.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-extent_m, extent_m, (num_points, 3))


def neighbour_sets(points: np.ndarray, radius_m: float) -> list[set[int]]:
    found = radius_neighbours(points, radius_m)
    lists = [found.rows[start:end].tolist() for start, end in zip(found.starts, found.ends, strict=True)]
    assert all(len(set(rows)) == len(rows) for rows in lists)
    return [set(rows) for rows in lists]


def test_range_limits_are_excluded_and_nan_is_out_of_range() -> None:
    points = np.array([[3.0, 0, 0], [0, 5, 0], [0, 0, 4], [np.nan, 4, 0], [np.inf, 0, 0]])
    np.testing.assert_array_equal(within_range(points, 3.0, 5.0), [False, False, True, False, False])


@pytest.mark.parametrize("seed", range(5))
def test_first_points_of_voxels_are_those_of_a_dictionary(seed: int) -> None:
    points = cloud(seed)
    first: dict[tuple[float, ...], int] = {}
    for row, cell in enumerate(np.floor(points / 1.7)):
        first.setdefault(tuple(cell), row)
    assert voxel_first(points, 1.7).tolist() == sorted(first.values())


@pytest.mark.parametrize("seed", range(5))
def test_voxel_means_are_those_of_a_dictionary_in_the_order_of_voxels(seed: int) -> None:
    points = cloud(seed)
    members: dict[tuple[float, ...], list[np.ndarray]] = {}
    for point, cell in zip(points, np.floor(points / 1.7), strict=True):
        members.setdefault(tuple(cell), []).append(point)
    expected = [np.mean(members[cell], axis=0) for cell in sorted(members)]
    np.testing.assert_allclose(voxel_means(points, 1.7), expected, atol=1e-12)


def test_voxel_means_of_float32_points_do_not_depend_on_their_order() -> None:
    points = (cloud(0, 50_000, 80.0)).astype(np.float32)
    order = np.random.default_rng(1).permutation(len(points))
    np.testing.assert_array_equal(voxel_means(points, 5.0), voxel_means(points[order], 5.0))


def test_voxel_means_count_the_points_between_two_ranges_only() -> None:
    points = cloud(0)
    chosen = points[within_range(points, 2.0, 7.0)]
    np.testing.assert_array_equal(voxel_means(points, 1.7, beyond_m=2.0, within_m=7.0), voxel_means(chosen, 1.7))
    assert len(voxel_means(np.zeros((1, 3)), 1.0)) == 1
    assert len(voxel_means(np.zeros((1, 3)), 1.0, beyond_m=0.0)) == 0


def test_the_normal_of_a_patch_is_that_of_its_points() -> None:
    points, patches = cloud(0), np.random.default_rng(0).integers(0, 400, (50, 10))
    expected = [np.linalg.eigh(np.cov(points[patch].T))[1][:, 0] for patch in patches]
    np.testing.assert_allclose(np.abs(np.sum(patch_normals(points, patches) * expected, axis=1)), 1.0, atol=1e-9)


def test_points_that_are_not_finite_are_in_no_voxel() -> None:
    points = np.array([[0.1, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [0.2, 0, 0], [5, 0, 0]])
    assert voxel_first(points, 1.0).tolist() == [0, 4]
    np.testing.assert_allclose(voxel_means(points, 1.0), [[0.15, 0, 0], [5, 0, 0]])


def test_voxels_of_no_points_are_none() -> None:
    assert voxel_first(np.empty((0, 3)), 1.0).tolist() == []
    assert voxel_means(np.empty((0, 3)), 1.0).shape == (0, 3)


@pytest.mark.parametrize("voxel_m", [0.0, -1.0])
def test_a_voxel_without_size_is_refused(voxel_m: float) -> None:
    with pytest.raises(ValueError, match="must be above 0, got"):
        voxel_first(cloud(0), voxel_m)


def test_points_spread_over_too_many_voxels_are_refused() -> None:
    with pytest.raises(ValueError, match="remove far points or enlarge"):
        voxel_first(np.array([[0.0, 0, 0], [1e30, 1e30, 1e30]]), 0.1)


@pytest.mark.parametrize("seed", range(5))
def test_neighbours_are_those_of_a_search_tree(seed: int) -> None:
    points = cloud(seed)
    expected = cKDTree(points).query_ball_point(points, 1.3)
    assert neighbour_sets(points, 1.3) == [set(rows) for rows in expected]


def test_neighbours_across_cells_and_at_the_very_radius_are_found() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(-2.0, 3.0)] * 3), axis=-1).reshape(-1, 3)
    inside = next(index for index, point in enumerate(grid) if not point.any())
    assert len(neighbour_sets(grid, 1.0)[inside]) == 7  # itself and one on each side
    flat = grid * [1, 1, 0] + [0, 0, 1e-9]
    assert {len(rows) for rows in neighbour_sets(flat, 1.0)} == {15, 20, 25}  # corners, edges, inside; 5 in each place


def test_more_neighbours_than_room_was_made_for_are_found() -> None:
    points = np.random.default_rng(0).normal(0, 0.01, (300, 3))
    assert all(len(rows) == 300 for rows in neighbour_sets(points, 1.0))


def test_no_points_have_no_neighbours() -> None:
    found = radius_neighbours(np.empty((0, 3)), 1.0)
    assert [len(column) for column in found] == [0, 0, 0]


def test_patch_covariances_are_numpys() -> None:
    points = cloud(3)
    covariances = patch_covariances(points, *radius_neighbours(points, 1.5))
    for row, inside in enumerate(cKDTree(points).query_ball_point(points, 1.5)):
        np.testing.assert_allclose(covariances[row], np.cov(points[inside].T, bias=True), atol=1e-12)


def test_normals_of_walls_face_the_sensor() -> None:
    side = np.stack(np.meshgrid(np.arange(-3.0, 3), np.arange(-3.0, 3)), axis=-1).reshape(-1, 2)
    for direction in (np.array([1.0, 0, 0]), np.array([0, -0.6, 0.8])):
        along = np.linalg.svd(direction[None])[2][1:]
        wall = side @ along + 8.0 * direction
        covariances = patch_covariances(wall, *radius_neighbours(wall, 2.0))
        np.testing.assert_allclose(normals(wall, covariances), np.tile(-direction, (len(wall), 1)), atol=1e-9)


def test_normals_are_the_eigenvectors_of_least_variance() -> None:
    rng = np.random.default_rng(0)
    patches = rng.normal(size=(500, 12, 3)) @ (
        np.diag([0.3, 0.2, 0.02]) @ np.linalg.qr(rng.normal(size=(500, 3, 3)))[0]
    )
    covariances = np.einsum("nki,nkj->nij", patches, patches)
    expected = np.linalg.eigh(covariances)[1][:, :, 0]
    found = normals(np.tile([20.0, 3, 1], (500, 1)), covariances)
    np.testing.assert_allclose(np.abs(np.sum(found * expected, axis=1)), 1.0, atol=1e-9)
    assert (found @ [20.0, 3, 1] <= 0).all()


@pytest.mark.parametrize("spread", [[0, 0, 0], [1, 1, 1], [1, 0, 0]], ids=["point", "ball", "line"])
def test_normals_of_what_has_none_are_zero_or_of_unit_length(spread: list[float]) -> None:
    length = np.linalg.norm(normals(np.array([[5.0, 0, 0]]), np.diag(spread).astype(float)[None]))
    assert length == pytest.approx(0.0) or length == pytest.approx(1.0)


def test_the_first_row_of_each_key_is_found() -> None:
    keys = np.random.default_rng(0).integers(-50, 50, 200) * 2**40
    values = keys.tolist()
    assert first_rows(keys).tolist() == [values.index(key) for key in values]


def test_canonical_order_gives_one_sequence_for_any_permutation() -> None:
    points = np.repeat(cloud(5).astype(np.float32), 2, axis=0)
    order = np.random.default_rng(6).permutation(len(points))
    np.testing.assert_array_equal(points[canonical_order(points)], points[order][canonical_order(points[order])])


def test_group_means_are_those_of_the_groups() -> None:
    rows, group = np.arange(12.0).reshape(4, 3), np.array([1, 0, 1, 0])
    np.testing.assert_array_equal(group_means(rows, group, 2), [rows[[1, 3]].mean(axis=0), rows[[0, 2]].mean(axis=0)])
