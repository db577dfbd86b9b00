"""The image that a network sees, against the plainest computation of each pixel."""

import math

import numpy as np
from helpers.made_networks import HEIGHT, SETTINGS, WIDTH

from segslam.labels.network_settings import NetworkSettings
from segslam.labels.range_image import EMPTY, Projection, network_input

NETWORK = NetworkSettings.model_validate(SETTINGS)


def _scan(num_points: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-30, -30, -8], [30, 30, 8], (num_points, 3))


def test_ahead_is_the_middle_behind_the_edge_and_right_of_ahead_right_of_the_middle() -> None:
    ahead, left, right, behind = Projection(
        np.array([[9.0, -0.1, 0], [0, 9.0, 0], [0, -9.0, 0], [-9.0, 0.1, 0]]), settings=NETWORK
    ).columns
    assert (ahead, left, right, behind) == (WIDTH // 2, WIDTH // 4, 3 * WIDTH // 4, 0)


def test_rows_go_down_and_what_is_beyond_the_field_of_view_lands_on_the_border() -> None:
    elevations = np.radians([40.0, 19.9, 1.0, -1.0, -19.9, -40.0])
    points = 10 * np.column_stack([np.cos(elevations), np.zeros(6), np.sin(elevations)])
    rows = Projection(points, settings=NETWORK).rows
    np.testing.assert_array_equal(rows, [0, 0, HEIGHT // 2 - 1, HEIGHT // 2, HEIGHT - 1, HEIGHT - 1])


def test_each_pixel_shows_the_nearest_of_its_points() -> None:
    points = _scan(4000)
    projection = Projection(points, settings=NETWORK)
    nearest: dict[tuple[int, int], int] = {}
    for index, (x, y, z) in enumerate(points):
        high = math.radians(20.0)
        row = int((high - math.atan2(z, math.hypot(x, y))) / (2 * high) * HEIGHT)
        column = int((math.pi - math.atan2(y, x)) / math.tau * WIDTH)
        pixel = min(max(row, 0), HEIGHT - 1), min(column, WIDTH - 1)
        other = nearest.setdefault(pixel, index)
        if np.linalg.norm(points[index]) < np.linalg.norm(points[other]):
            nearest[pixel] = index
    expected = np.full((HEIGHT, WIDTH), EMPTY)
    for pixel, index in nearest.items():
        expected[pixel] = index
    np.testing.assert_array_equal(projection.nearest, expected)


def test_channels_are_normalised_in_the_given_order_and_empty_pixels_are_zero() -> None:
    points, intensities = np.array([[3.0, 0.0, 4.0], [0.0, 5.0, 0.1]]), np.array([0.5, 1.0])
    backwards = NetworkSettings.model_validate(
        SETTINGS
        | {"channels": ["intensity", "z", "y", "x", "range"], "mean": [0.5, 0, 0, 1, 5], "std": [1, 2, 1, 1, 1]}
    )
    projection = Projection(points, settings=backwards)
    image = network_input(points, intensities, projection, settings=backwards)[0]
    at = projection.rows[0], projection.columns[0]
    np.testing.assert_allclose(image[:, *at], [0.0, 2.0, 0.0, 2.0, 0.0], atol=1e-6)
    assert np.count_nonzero(image.any(axis=0)) == 2


def test_pixels_without_a_point_are_exactly_zero_in_every_channel_including_the_mask() -> None:
    points = _scan(500)
    channels = {"channels": ["range", "x", "y", "z", "intensity", "mask"], "mean": [9, 8, 7, 6, 5, 0], "std": [1] * 6}
    settings = NetworkSettings.model_validate(SETTINGS | channels)
    projection = Projection(points, settings=settings)
    image = network_input(points, np.zeros(500), projection, settings=settings)[0]
    is_empty = projection.nearest == EMPTY
    assert 0 < is_empty.sum() < is_empty.size
    assert (image[:, is_empty] == 0).all()
    np.testing.assert_array_equal(image[5], ~is_empty)
    assert (image[:5, ~is_empty] != 0).any(axis=0).all()


def test_ranges_of_the_image_are_infinite_where_nothing_returned() -> None:
    projection = Projection(np.array([[3.0, 0.0, 0.4]]), settings=NETWORK)
    ranges_m = projection.image_ranges_m()
    assert np.isfinite(ranges_m).sum() == 1
    assert ranges_m.min() == projection.ranges_m[0]
