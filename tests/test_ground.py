"""Planes, slopes and levels of known height; kernels against plain NumPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segslam.semantics import ground
from segslam.semantics.ground import heights_above_ground, turned, upright

SENSOR_HEIGHT_M = 1.7
LIMITS = {"cell_m": 1.0, "max_range_m": 40.0, "max_slope": 0.2}


def _plain(rng, *, num_points=20_000, radius_m=30.0, height_at=lambda x, y: 0.0 * x):
    """Ground points around a sensor SENSOR_HEIGHT_M above the middle, thinning out as those of a LiDAR do."""
    radius = radius_m * rng.uniform(0.1, 1.0, num_points)
    azimuth = rng.uniform(0.0, 2 * np.pi, num_points)
    x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
    return np.column_stack([x, y, height_at(x, y) - SENSOR_HEIGHT_M + rng.normal(0.0, 0.01, num_points)])


def _box(rng, low, high, num_points):
    return rng.uniform(low, high, (num_points, 3))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.mark.parametrize("tilt_deg", [0.0, 3.0, 20.0, 35.0])
@pytest.mark.parametrize("direction_deg", [0.0, 130.0])
def test_a_leaning_sensor_is_set_upright(rng, tilt_deg, direction_deg):
    axis = np.array([np.cos(np.radians(direction_deg)), np.sin(np.radians(direction_deg)), 0.0])
    R_lidar_level = Rotation.from_rotvec(np.radians(tilt_deg) * axis).as_matrix()
    up = upright(_plain(rng) @ R_lidar_level.T) @ R_lidar_level[:, 2]
    # 20,000 points, 1 cm of noise, and the lowest of each square metre biased alike: some hundredths of a degree
    assert np.degrees(np.arccos(min(up[2], 1.0))) < 0.1


def test_setting_upright_does_not_turn_about_the_vertical(rng):
    R_lidar_level = Rotation.from_euler("x", 15.0, degrees=True).as_matrix()
    R_level_lidar = upright(_plain(rng) @ R_lidar_level.T)
    np.testing.assert_allclose(Rotation.from_matrix(R_level_lidar).as_rotvec()[2], 0.0, atol=1e-12)


def test_a_ceiling_and_walls_larger_than_the_floor_do_not_pass_for_it(rng):
    floor = _plain(rng, num_points=2000, radius_m=4.0)
    ceiling = _box(rng, [-12, -12, 2.4], [12, 12, 2.6], 20_000)
    wall = _box(rng, [5.0, -12, -1.7], [5.1, 12, 2.4], 20_000)
    np.testing.assert_allclose(upright(np.vstack([floor, ceiling, wall]))[2], [0, 0, 1], atol=0.01)


@pytest.mark.parametrize("num_points", [0, 1, 9])
def test_too_little_ground_leaves_the_frame_as_it_is(rng, num_points):
    np.testing.assert_array_equal(upright(_plain(rng, num_points=num_points)), np.eye(3))


def test_points_high_above_a_plain_have_their_height(rng):
    things = _box(rng, [-20, -20, -SENSOR_HEIGHT_M + 1], [20, 20, -SENSOR_HEIGHT_M + 3], 500)
    heights = heights_above_ground(np.vstack([_plain(rng), things]), **LIMITS)
    np.testing.assert_allclose(heights[-500:], things[:, 2] + SENSOR_HEIGHT_M, atol=0.06)


def test_a_hill_is_followed(rng):
    def hill(x, y):  # as steep as 12 %
        return 1.5 * np.sin(0.08 * x) * np.cos(0.08 * y)

    heights = heights_above_ground(_plain(rng, num_points=60_000, height_at=hill), **LIMITS)
    assert np.mean(np.abs(heights) < 0.15) > 0.99


def test_what_hangs_over_the_road_is_no_ground_and_hides_none(rng):
    bridge = _box(rng, [8, -30, 3.0], [14, 30, 3.3], 20_000)
    heights = heights_above_ground(np.vstack([_plain(rng), bridge]), **LIMITS)
    assert np.abs(heights[:20_000]).max() < 0.1
    assert heights[20_000:].min() > 4.5


def test_a_deck_that_covers_the_ground_behind_it_stands_above_the_ground_before_it(rng):
    near = _plain(rng, radius_m=10.0)
    roofs = _box(rng, [12, -20, 1.0], [30, 20, 1.1], 20_000)
    heights = heights_above_ground(np.vstack([near, roofs]), **LIMITS)
    np.testing.assert_allclose(heights[20_000:], roofs[:, 2] + SENSOR_HEIGHT_M, atol=0.1)


def test_reflections_below_the_road_do_not_pull_it_down(rng):
    below = _box(rng, [-30, -30, -8.0], [30, 30, -3.0], 500)
    heights = heights_above_ground(np.vstack([_plain(rng), below]), **LIMITS)
    assert np.abs(heights[:20_000]).max() < 0.1


def test_the_box_of_a_car_does_not_lift_the_ground_beside_it(rng):
    car = _box(rng, [5, 2, -1.5], [9.5, 3.8, -0.2], 5000)
    points = np.vstack([_plain(rng), car])
    heights = heights_above_ground(points, **LIMITS)
    np.testing.assert_allclose(heights[20_000:], car[:, 2] + SENSOR_HEIGHT_M, atol=0.1)


def test_permuting_the_points_permutes_the_heights_exactly(rng):
    points = _plain(rng)
    order = rng.permutation(len(points))
    np.testing.assert_array_equal(
        heights_above_ground(points[order], **LIMITS), heights_above_ground(points, **LIMITS)[order]
    )
    np.testing.assert_array_equal(upright(points[order]), upright(points))


def test_no_points_have_no_heights():
    assert heights_above_ground(np.empty((0, 3)), **LIMITS).shape == (0,)


def test_points_beyond_the_grid_are_measured_from_its_border(rng):
    heights = heights_above_ground(np.vstack([_plain(rng), [[500.0, 0.0, 1.0]]]), **LIMITS)
    np.testing.assert_allclose(heights[-1], 1.0 + SENSOR_HEIGHT_M, atol=0.1)


def test_turning_agrees_with_the_matrix_product(rng):
    R_a_b = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    points = rng.normal(size=(50, 3))
    np.testing.assert_allclose(turned(points, R_a_b), points @ R_a_b.T, atol=1e-12)


def test_the_lowest_of_each_square_metre_agrees_with_a_search(rng):
    points = np.round(rng.uniform(-6, 6, (3000, 3)), 1)  # rounded: many are equally low
    cells = {}
    for point in points[np.hypot(points[:, 0], points[:, 1]) < 5]:
        cells.setdefault((np.floor(point[0]), np.floor(point[1])), []).append((point[2], point[0], point[1]))
    expected = sorted((x, y, z) for z, x, y in map(min, cells.values()))
    np.testing.assert_array_equal(sorted(map(tuple, ground._lowest_of_cells(points, 5.0))), expected)


def test_votes_agree_with_histograms(rng):
    points, normals = rng.normal(0, 2, (200, 3)), ground._upward_normals()[:20]
    expected = [np.histogram(-points @ normal, np.arange(0.0, 5.01, 0.2))[0] for normal in normals]
    expected = np.array(expected)
    expected[:, 0] = 0
    np.testing.assert_array_equal(ground._votes(points, normals, 0.2, 25), expected)


def test_grouping_agrees_with_a_stable_sort(rng):
    group = rng.integers(0, 30, 500)
    order, starts = ground._grouped(group, 31)
    np.testing.assert_array_equal(order, np.argsort(group, kind="stable"))
    np.testing.assert_array_equal(np.diff(starts), np.bincount(group, minlength=31))


def test_interpolation_is_exact_on_a_plane(rng):
    half, cell_m = 6, 0.5
    centres = (np.arange(-half, half) + 0.5) * cell_m
    surface = 0.3 * centres[:, None] - 0.2 * centres + 1.0
    points = rng.uniform(centres[0], centres[-1], (100, 3))
    expected = 0.3 * points[:, 0] - 0.2 * points[:, 1] + 1.0
    np.testing.assert_allclose(ground._interpolate(points, surface, half, cell_m), expected, atol=1e-12)


@pytest.mark.data
def test_real_handheld_scans_are_levelled_alike_wherever_the_sensor_leans(data_dir):
    folder = data_dir / "courtyard"
    R_world_lidar = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)[:, :, :3]
    ups = []
    for index in (0, 27, 36, 45, 54, 72, 99):  # the sensor leans 3 to 33 degrees
        points = np.fromfile(folder / "velodyne" / f"{index:06d}.bin", np.float32).reshape(-1, 4)[:, :3]
        ups.append(R_world_lidar[index] @ upright(points.astype(np.float64))[2])
    spread_deg = np.degrees(np.arccos(np.clip(ups @ np.mean(ups, axis=0), -1, 1)))
    assert spread_deg.max() < 1.0
