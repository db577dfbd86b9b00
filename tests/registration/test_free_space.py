import math

import numpy as np
import pytest

from segslam.core.config import VerifyConfig
from segslam.registration.free_space import (
    AT_RETURN,
    BEHIND,
    IN_FRONT,
    NO_RETURN,
    NUM_COLUMNS,
    FreeSpace,
    fates,
    violation,
)

CONFIG = VerifyConfig()


def _ring(radius_m: float, *, azimuths_deg: tuple[float, float] = (-180.0, 180.0)) -> np.ndarray:
    azimuth, height = np.meshgrid(np.radians(np.arange(*azimuths_deg, 0.5)), np.arange(-3.0, 3.0, 0.1))
    return np.column_stack([radius_m * np.cos(azimuth.ravel()), radius_m * np.sin(azimuth.ravel()), height.ravel()])


def _dome(elevations_deg: np.ndarray, *, radius_m: float = 20.0, azimuths_deg: np.ndarray | None = None) -> np.ndarray:
    azimuths = np.arange(-180.0, 180.0, 0.3) if azimuths_deg is None else azimuths_deg
    azimuth, elevation = (np.radians(grid).ravel() for grid in np.meshgrid(azimuths, elevations_deg))
    flat = radius_m * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), radius_m * np.sin(elevation)])


@pytest.mark.parametrize(
    ("beams", "low_deg", "high_deg"),
    [(16, -15.0, 15.0), (32, -25.0, 15.0), (64, -22.5, 22.5), (128, -22.5, 22.5), (64, -45.0, 45.0), (12, -14.0, 14.0)],
)
def test_rows_are_as_fine_as_the_beams(beams: int, low_deg: float, high_deg: float) -> None:
    seen = FreeSpace(_dome(np.linspace(low_deg, high_deg, beams)))
    spacing_deg = (high_deg - low_deg) / (beams - 1)
    assert 0.7 * max(spacing_deg, 0.5) <= math.degrees(seen.row_rad) <= 1.5 * max(spacing_deg, 0.5)
    assert np.isfinite(seen.nearest_m).mean() > 0.6, "few rows without a beam"
    assert seen.lowest_rad == pytest.approx(math.radians(low_deg), abs=1e-6)


def test_a_pattern_that_never_repeats_and_a_narrow_view_are_seen_whole() -> None:
    rng = np.random.default_rng(0)
    sine = rng.uniform(math.sin(math.radians(-7.0)), math.sin(math.radians(52.0)), 30_000)
    azimuth = np.radians(rng.uniform(-35.0, 35.0, 30_000))
    flat = np.sqrt(1.0 - sine**2)
    points = 10.0 * np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), sine])
    seen = FreeSpace(points)
    assert math.degrees(seen.row_rad) <= 1.0
    assert np.isfinite(seen.nearest_m).any(axis=0).sum() == pytest.approx(70, abs=2), "columns of one degree"
    assert violation(0.5 * points, seen, np.eye(4)) > 0.99
    assert violation(points, seen, np.eye(4)) == 0.0


def test_what_stands_near_a_sensor_that_looks_steeply_up_counts() -> None:
    """At 40 degrees and 2 m: beyond 30 degrees and nearer than 3 m, where nothing may be taken for granted."""
    ceiling = _dome(np.linspace(-45.0, 45.0, 64), radius_m=6.0)
    near = _dome(np.array([40.0]), radius_m=2.0)
    assert violation(near, FreeSpace(ceiling), np.eye(4)) == 1.0


def test_the_margin_shrinks_with_the_place() -> None:
    """0.6 m before a wall: within the margin of a street, a violation in a corridor."""
    for radius_m, share in ((20.0, 0.0), (2.4, 1.0)):
        seen = FreeSpace(_dome(np.linspace(-22.5, 22.5, 64), radius_m=radius_m))
        before = _dome(np.linspace(-20.0, 20.0, 64), radius_m=radius_m - 0.6)
        assert violation(before, seen, np.eye(4)) == share, radius_m


def test_a_view_holds_the_nearest_return_around_each_direction_that_has_one() -> None:
    """Two returns in one cell, and one in the cell beside."""
    seen = FreeSpace(np.array([[10.0, 0.05, 0.0], [20.0, 0.1, 0.1], [20.0, 0.5, 0.0]]))
    expected = np.full(NUM_COLUMNS, np.inf)
    expected[NUM_COLUMNS // 2 : NUM_COLUMNS // 2 + 2] = 10.0
    np.testing.assert_allclose(seen.nearest_m.min(axis=0), expected, rtol=1e-4)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((3, 3), np.nan), np.zeros((2, 3))])
def test_a_scan_without_returns_sees_nothing(points: np.ndarray) -> None:
    seen = FreeSpace(points)
    assert not np.isfinite(seen.nearest_m).any()
    assert violation(_ring(10.0), seen, np.eye(4)) == 0.0


def test_a_view_wraps_behind_the_sensor() -> None:
    seen = FreeSpace(np.array([[-10.0, 0.01, 0.05], [-20.0, -0.01, 0.05]])).nearest_m
    np.testing.assert_allclose(seen.min(axis=0)[[0, -1]], 10.0, rtol=1e-4)


def test_ground_whose_grazing_rays_were_lost_does_not_stand_in_the_way_to_the_wall_behind() -> None:
    wall = _ring(20.0)
    far_ground = np.array([[17.0, 0.0, -1.34]])  # 4.5 degrees down, in the row below the lowest of the wall
    seen = FreeSpace(wall[wall[:, 2] > -1.35])  # down to 3.7 degrees
    assert np.isfinite(seen.nearest_m).any()
    assert violation(far_ground, seen, np.eye(4)) == 0.0


def test_points_before_a_wall_that_was_seen_violate_and_points_behind_it_do_not() -> None:
    wall = FreeSpace(_ring(20.0))
    assert violation(_ring(10.0), wall, np.eye(4)) == 1.0
    assert violation(_ring(30.0), wall, np.eye(4)) == 0.0
    assert violation(_ring(20.0), wall, np.eye(4)) == 0.0


def test_the_share_is_of_points_where_something_returned() -> None:
    half_seen = FreeSpace(_ring(20.0, azimuths_deg=(0.0, 90.0)))
    assert violation(_ring(10.0), half_seen, np.eye(4)) == 1.0
    ahead_only = _ring(10.0, azimuths_deg=(180.0, 270.0))
    assert violation(ahead_only, half_seen, np.eye(4)) == 0.0


def test_points_are_in_front_of_a_return_at_it_behind_it_or_where_nothing_returned() -> None:
    seen = FreeSpace(_ring(20.0, azimuths_deg=(-90.0, 90.0)))
    found = [fates(radius_m * np.array([[np.cos(yaw), np.sin(yaw), 0.0]]), seen)[0]
             for radius_m, yaw in ((10.0, 0.5), (20.5, 0.5), (30.0, 0.5), (10.0, 3.0))]  # fmt: skip
    assert found == [IN_FRONT, AT_RETURN, BEHIND, NO_RETURN]
