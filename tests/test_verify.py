import math

import numpy as np
import pytest
from streets import corner

from segslam import geometry, refine
from segslam.config import RefineConfig, VerifyConfig
from segslam.types import RejectReason
from segslam.verify import NUM_COLUMNS, NUM_ROWS, Agreement, View, agreement, free_space_violation, rejection, view

CONFIG = VerifyConfig()
REFINE = RefineConfig()
RIGHT = Agreement(overlap=0.9, rms_m=0.05, free_space_violation=0.0)


def _prepared(points: np.ndarray) -> tuple[refine.Surface, View]:
    return refine.prepare(refine.thin(points, config=REFINE), config=REFINE), view(points)


def _ring(radius_m: float, *, azimuths_deg: tuple[float, float] = (-180.0, 180.0)) -> np.ndarray:
    azimuth, height = np.meshgrid(np.radians(np.arange(*azimuths_deg, 0.5)), np.arange(-3.0, 3.0, 0.1))
    return np.column_stack([radius_m * np.cos(azimuth.ravel()), radius_m * np.sin(azimuth.ravel()), height.ravel()])


def test_a_view_holds_the_nearest_return_around_each_direction_that_has_one() -> None:
    points = np.array(
        [[10.0, 0.05, 0.05], [20.0, 0.1, 0.1], [20.0, 0.5, 0.1], [1.0, 0.0, 0.0]]
    )  # the last: the vehicle
    expected = np.full((NUM_ROWS, NUM_COLUMNS), np.inf)
    expected[NUM_ROWS // 2, NUM_COLUMNS // 2 : NUM_COLUMNS // 2 + 2] = 10.0
    np.testing.assert_allclose(view(points).nearest_m, expected, rtol=1e-4)


def test_a_view_wraps_behind_the_sensor() -> None:
    seen = view(np.array([[-10.0, 0.01, 0.05], [-20.0, -0.01, 0.05]])).nearest_m
    np.testing.assert_allclose(seen[NUM_ROWS // 2, [0, -1]], 10.0, rtol=1e-4)


def test_ground_whose_grazing_rays_were_lost_does_not_stand_in_the_way_to_the_wall_behind() -> None:
    wall = _ring(20.0)
    far_ground = np.array([[17.0, 0.0, -1.34]])  # 4.5 degrees down, in the row below the lowest of the wall
    seen = view(wall[wall[:, 2] > -1.35])  # down to 3.7 degrees
    assert np.isfinite(seen.nearest_m).any()
    assert free_space_violation(far_ground, seen, np.eye(4), config=CONFIG) == 0.0


def test_points_before_a_wall_that_was_seen_violate_and_points_behind_it_do_not() -> None:
    wall = view(_ring(20.0))
    assert free_space_violation(_ring(10.0), wall, np.eye(4), config=CONFIG) == 1.0
    assert free_space_violation(_ring(30.0), wall, np.eye(4), config=CONFIG) == 0.0
    assert free_space_violation(_ring(20.0), wall, np.eye(4), config=CONFIG) == 0.0


def test_the_share_is_of_points_where_something_returned() -> None:
    half_seen = view(_ring(20.0, azimuths_deg=(0.0, 90.0)))
    assert free_space_violation(_ring(10.0), half_seen, np.eye(4), config=CONFIG) == 1.0
    ahead_only = _ring(10.0, azimuths_deg=(180.0, 270.0))
    assert free_space_violation(ahead_only, half_seen, np.eye(4), config=CONFIG) == 0.0


def test_swapping_the_scans_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    T_target_source = geometry.transform(geometry.yaw(0.4), [4.0, 1.0, 0.0])
    cloud = corner(rng)
    scans = [_prepared(points) for points in (geometry.apply(geometry.inverse(T_target_source), cloud), cloud)]
    forth = agreement(scans[0], scans[1], T_target_source, config=CONFIG)
    back = agreement(scans[1], scans[0], geometry.inverse(T_target_source), config=CONFIG)
    assert forth.overlap == pytest.approx(back.overlap)
    assert forth.rms_m == pytest.approx(back.rms_m)
    assert forth.overlap > 0.95


def test_scans_out_of_each_other_s_reach_do_not_overlap() -> None:
    points = corner(np.random.default_rng(0))
    scan = _prepared(points)
    far = agreement(scan, scan, geometry.transform(np.eye(3), [200.0, 0.0, 0.0]), config=CONFIG)
    assert far.overlap == 0.0
    assert math.isinf(far.rms_m)


def test_ground_alone_is_no_overlap() -> None:
    """The same ground, and other walls upon it."""
    rng = np.random.default_rng(0)
    one, other = (_prepared(points) for points in (corner(rng), corner(rng) * [1.0, -1.0, 1.0]))
    found = agreement(one, other, np.eye(4), config=CONFIG)
    to_point, _ = one[0].distances_m(other[0].points)
    assert (to_point < CONFIG.inlier_m).mean() > 0.3, "the ground is a third of the points"
    rejected = rejection(found, config=CONFIG)
    assert rejected is not None
    assert rejected.reason is RejectReason.LOW_OVERLAP


def test_each_test_rejects_for_its_own_reason() -> None:
    assert rejection(RIGHT, config=CONFIG) is None
    cases = {
        RejectReason.LOW_OVERLAP: Agreement(0.1, 0.05, 0.0),
        RejectReason.HIGH_RESIDUAL: Agreement(0.9, 0.5, 0.0),
        RejectReason.FREE_SPACE_VIOLATED: Agreement(0.9, 0.05, 0.2),
    }
    for reason, found in cases.items():
        rejected = rejection(found, config=CONFIG)
        assert rejected is not None
        assert rejected.reason is reason


@pytest.mark.data
def test_real_pairs_are_believed_at_the_true_pose_and_not_a_car_s_length_away(real_pairs) -> None:
    for pair in real_pairs.pairs:
        scans = [_prepared(real_pairs.points(index)) for index in (pair.source, pair.target)]
        right = agreement(scans[0], scans[1], pair.T_target_source, config=CONFIG)
        assert rejection(right, config=CONFIG) is None, f"{pair.source} -> {pair.target}: {right}"
        for shift in ([4.0, 0.0, 0.0], [-4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, -4.0, 0.0]):
            T_wrong = pair.T_target_source @ geometry.transform(np.eye(3), shift)
            wrong = agreement(scans[0], scans[1], T_wrong, config=CONFIG)
            assert rejection(wrong, config=CONFIG) is not None, f"{pair}: {shift}: {wrong}"
