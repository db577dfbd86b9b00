import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.streets import corner

from segslam.core import geometry
from segslam.core.config import RefineConfig, VerifyConfig
from segslam.core.types import RejectReason
from segslam.registration import refinement
from segslam.registration.free_space import observe_free_space
from segslam.verification.gates import (
    NARROW_VIEW,
    SINGLE_PAIR,
    Agreement,
    NoiseFloor,
    Observed,
    agreement,
    contradicts,
    early_rejection,
    is_certain,
    limits,
    rejection,
    weak_support,
)

CONFIG = VerifyConfig()
REFINE = RefineConfig()
LIMITS = limits(SINGLE_PAIR, config=CONFIG)
RIGHT = Agreement(overlap=0.9, rms_m=0.05, residual_ratio=0.7, free_space_violation=0.0, free_path_m=7.0)


def _prepared(points: np.ndarray) -> Observed:
    return refinement.make_surface(refinement.downsample(points, config=REFINE), config=REFINE), observe_free_space(
        points
    )


def _room(pillar_m: float | None = None) -> Observed:
    """Two walls and an end wall 12 m ahead; perhaps the front of a pillar at the left wall."""
    u, v = np.meshgrid(np.arange(0.05, 1.0, 0.02), np.arange(-1.0, 1.5, 0.15))
    x, z = 1.5 + 10.5 * u.ravel(), v.ravel()
    parts = [np.column_stack([x, np.full_like(x, side), z]) for side in (-2.5, 2.5)]
    parts.append(np.column_stack([np.full_like(x, 12.0), 5.0 * u.ravel() - 2.5, z]))
    if pillar_m is not None:
        parts.append(np.column_stack([np.full_like(x, pillar_m), 2.5 - 2.0 * u.ravel(), z]))
    return _prepared(np.concatenate(parts))


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
    rejected = rejection(found, LIMITS)
    assert rejected is not None
    assert rejected.reason is RejectReason.LOW_OVERLAP


def test_each_test_rejects_for_its_own_reason() -> None:
    assert rejection(RIGHT, LIMITS) is None
    cases = {
        RejectReason.LOW_OVERLAP: Agreement(0.1, 0.05, 0.7, 0.0, 7.0),
        RejectReason.HIGH_RESIDUAL: Agreement(0.9, 0.5, 3.0, 0.0, 7.0),
        RejectReason.FREE_SPACE_VIOLATED: Agreement(0.9, 0.05, 0.7, 0.2, 7.0),
    }
    for reason, found in cases.items():
        rejected = rejection(found, LIMITS)
        assert rejected is not None
        assert rejected.reason is reason


def test_in_an_open_place_a_pose_that_is_free_may_have_a_larger_residual() -> None:
    """Bushes and cars seen from two sides have residuals at the correct pose, too."""
    rough = replace(RIGHT, residual_ratio=1.15 * LIMITS.max_residual_ratio, free_space_violation=0.001)
    assert rejection(rough, LIMITS) is None
    for worse in (
        replace(rough, free_space_violation=0.004),
        replace(rough, free_path_m=5.0),
        replace(rough, residual_ratio=1.25 * LIMITS.max_residual_ratio),
    ):
        rejected = rejection(worse, LIMITS)
        assert rejected is not None
        assert rejected.reason is RejectReason.HIGH_RESIDUAL


def test_in_a_narrow_place_surfaces_must_not_be_displaced() -> None:
    """However rough they are; in an open place the errors of the angles displace them, too."""
    displaced = replace(RIGHT, common_residual_m=0.09, free_path_m=3.0)
    rejected = rejection(displaced, LIMITS)
    assert rejected is not None
    assert rejected.reason is RejectReason.HIGH_RESIDUAL
    assert rejected.detail == "0.090 m > 0.070 m in common over patches of 1.5 m"
    assert rejection(replace(displaced, common_residual_m=0.05), LIMITS) is None
    assert rejection(replace(displaced, free_path_m=8.0), LIMITS) is None
    assert rejection(displaced, LIMITS.loosened()) is None, "a rival needs less evidence"


def test_a_residual_is_measured_by_the_roughness_of_the_rougher_scan() -> None:
    rng = np.random.default_rng(3)
    rough, smooth = (
        _prepared(cloud + rng.normal(scale=sigma_m, size=cloud.shape))
        for sigma_m, cloud in ((0.1, corner(rng)), (0.01, corner(rng)))
    )
    assert rough[0].roughness_m > 1.5 * smooth[0].roughness_m
    found = agreement(rough, smooth, np.eye(4), config=CONFIG)
    assert found.residual_ratio == pytest.approx(found.rms_m / max(rough[0].roughness_m, smooth[0].roughness_m))


def test_limits_adapt_to_a_noisier_sensor() -> None:
    """10 cm of range noise increase residual and roughness equally; a wrong pose is still rejected."""
    T_wrong = geometry.transform(np.eye(3), [1.5, 0.0, 0.0])
    for sigma_m in (0.01, 0.1):
        rng = np.random.default_rng(4)
        scans = [_prepared(cloud + rng.normal(scale=sigma_m, size=cloud.shape)) for cloud in (corner(rng), corner(rng))]
        right = agreement(*scans, np.eye(4), config=CONFIG)
        assert rejection(right, LIMITS) is None, (sigma_m, right)
        wrong = agreement(*scans, T_wrong, config=CONFIG)
        assert rejection(wrong, LIMITS) is not None, (sigma_m, wrong)


def test_limits_follow_the_neighbours_of_the_run() -> None:
    worse = limits(NoiseFloor(overlap=0.6, residual_ratio=0.9, free_space_violation=0.01), config=CONFIG)
    assert worse.min_overlap < LIMITS.min_overlap
    assert worse.max_residual_ratio == pytest.approx(0.9 * CONFIG.max_residual_ratio)
    assert worse.max_free_space_violation == pytest.approx(0.01 * CONFIG.max_violation_ratio)
    better = limits(NoiseFloor(overlap=0.99, residual_ratio=0.7, free_space_violation=0.0), config=CONFIG)
    assert better.min_overlap == CONFIG.min_overlap
    assert better.max_residual_ratio == pytest.approx(0.7 * CONFIG.max_residual_ratio)
    assert better.max_free_space_violation == CONFIG.max_free_space_violation


def test_in_a_narrow_place_scans_that_overlap_as_neighbours_do_must_fit_nearly_as_well() -> None:
    floor = NoiseFloor(overlap=0.8, residual_ratio=0.7, free_space_violation=0.0)
    allowed = limits(floor, config=CONFIG)
    most = allowed.max_residual_ratio, allowed.max_free_space_violation
    narrow_m, street_m = 3.0, 7.0
    assert allowed.at(0.4, narrow_m) == allowed.at(0.1, narrow_m) == pytest.approx(most), "half of that overlap"
    assert allowed.at(0.8, narrow_m) == allowed.at(0.95, narrow_m) == pytest.approx((0.85 * most[0], 0.5 * most[1]))
    assert allowed.at(0.8, street_m) == pytest.approx(most), "in a street the parked cars change"
    between = Agreement(0.8, 0.1, residual_ratio=0.9 * most[0], free_space_violation=0.0, free_path_m=narrow_m)
    rejected = rejection(between, allowed)
    assert rejected is not None
    assert rejected.reason is RejectReason.HIGH_RESIDUAL
    assert rejection(replace(between, overlap=0.4), allowed) is None
    assert rejection(between, allowed.unreduced()) is None


def test_a_wall_that_every_corridor_ends_with_is_no_second_surface() -> None:
    """Two corridors with the same end; in one of them stands a pillar."""
    ends, pillar = _room(), _room(pillar_m=5.0)
    along = np.array([1.0, 0.0, 0.0])
    same = weak_support(pillar[0], pillar[0], np.eye(4), along, config=CONFIG)
    assert min(same) > 0.9
    other = weak_support(pillar[0], ends[0], np.eye(4), along, config=CONFIG)
    assert other.whole > CONFIG.min_weak_support
    assert other.second < 0.05


def test_a_scan_that_looks_one_way_has_a_narrow_view() -> None:
    assert _room()[1].view < NARROW_VIEW
    azimuth = np.radians(np.arange(0.0, 360.0, 0.5))
    around = np.column_stack([8.0 * np.cos(azimuth), 8.0 * np.sin(azimuth), np.zeros(len(azimuth))])
    assert observe_free_space(around).view == 1.0


def test_neighbours_that_share_their_points_do_not_make_the_limit_stricter_than_other_scans_can_reach() -> None:
    shared = limits(NoiseFloor(overlap=1.0, residual_ratio=0.1, free_space_violation=0.0), config=CONFIG)
    assert shared.max_residual_ratio > 0.8


def test_an_alignment_is_certain_if_it_agrees_as_well_as_neighbours_do() -> None:
    assert is_certain(Agreement(0.7, 0.1, SINGLE_PAIR.residual_ratio, 0.004, 7.0), SINGLE_PAIR)
    assert not is_certain(Agreement(0.7, 0.1, 1.4 * SINGLE_PAIR.residual_ratio, 0.004, 7.0), SINGLE_PAIR)
    assert not is_certain(Agreement(0.7, 0.1, SINGLE_PAIR.residual_ratio, 0.02, 7.0), SINGLE_PAIR)


@pytest.mark.parametrize(
    ("best", "other", "floor", "is_contradicted"),
    [
        (0.001, 0.030, 0.002, True),
        (0.001, 0.012, 0.002, False),  # not much more
        (0.020, 0.090, 0.002, False),  # violates free space itself, as where cars have come and gone
        (0.020, 0.030, 0.010, False),  # the neighbours of the run violate it as much
        (0.020, 0.100, 0.010, True),
    ],
)
def test_a_pose_contradicts_others_only_if_it_violates_free_space_as_little_as_neighbours_do(
    best: float, other: float, floor: float, is_contradicted: bool
) -> None:
    neighbours = NoiseFloor(overlap=0.93, residual_ratio=0.78, free_space_violation=floor)
    poses = [Agreement(0.5, 0.1, 0.9, violation, 7.0) for violation in (best, other)]
    assert contradicts(*poses, neighbours) is is_contradicted
    assert not contradicts(*poses[::-1], neighbours)


def test_a_coarse_pose_is_rejected_early_beyond_three_times_the_free_space_allowed() -> None:
    """A wall 20 m away, and a source whose wall stands before it in a part of the view."""
    azimuth, height = np.meshgrid(np.radians(np.arange(-180.0, 180.0, 0.5)), np.arange(-3.0, 3.0, 0.1))
    flat = np.column_stack([np.cos(azimuth.ravel()), np.sin(azimuth.ravel())])
    outcomes = {}
    for share in (0.0, 0.05, 0.4):
        radius_m = np.where(np.linspace(0.0, 1.0, len(flat)) < share, 10.0, 20.0)
        source = _prepared(np.column_stack([flat * radius_m[:, None], height.ravel()]))
        target = _prepared(np.column_stack([flat * 20.0, height.ravel()]))
        outcomes[share] = early_rejection(source, target, np.eye(4), LIMITS, config=CONFIG)
    assert outcomes[0.0] is None
    assert outcomes[0.05] is None, "more than allowed in the end, but refinement may correct it"
    assert outcomes[0.4] is not None
    assert outcomes[0.4].reason is RejectReason.FREE_SPACE_VIOLATED


@pytest.mark.data
def test_real_pairs_are_accepted_at_the_true_pose_and_not_a_car_s_length_away(real_pairs) -> None:
    for pair in real_pairs.pairs:
        scans = [_prepared(real_pairs.points(index)) for index in (pair.source, pair.target)]
        right = agreement(scans[0], scans[1], pair.T_target_source, config=CONFIG)
        assert rejection(right, LIMITS) is None, f"{pair.source} -> {pair.target}: {right}"
        for shift in ([4.0, 0.0, 0.0], [-4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, -4.0, 0.0]):
            T_wrong = pair.T_target_source @ geometry.transform(np.eye(3), shift)
            wrong = agreement(scans[0], scans[1], T_wrong, config=CONFIG)
            assert rejection(wrong, LIMITS) is not None, f"{pair}: {shift}: {wrong}"
