"""Laying clusters and ground on each other: pairing, symmetry, what leaves a pose open."""

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.types import Description, Label, Registration, Rejected, RejectReason, Transform
from segslam.registration.segregator import descent, gaussians
from segslam.registration.segregator.correspondences import Correspondences
from segslam.registration.segregator.gaussians import align_gaussians, nearest_pairs, nearest_planes
from segslam.registration.segregator.match import putative

CONFIG = SegregatorConfig()
T_TRUE = geometry.exp(geometry.tangent(rotation_rad=[0.02, -0.03, 2.0], translation_m=[6.0, -3.0, 0.4]))
NO_GROUND = np.empty((0, 3))


def scan(
    means: np.ndarray, ground: np.ndarray, normals: np.ndarray | None = None, spread_m: float = 0.3
) -> Description:
    count = len(means)
    return Description(
        means=means,
        covariances=np.tile(spread_m**2 * np.eye(3), (count, 1, 1)),
        classes=np.full(count, Label.TRUNK, np.uint8),
        sizes=np.full(count, 30),
        feature_points=np.empty((0, 3)),
        feature_covariances=np.empty((0, 3, 3)),
        feature_classes=np.empty(0, np.uint8),
        feature_descriptors=np.empty((0, 33)),
        ground_points=ground,
        ground_normals=np.tile([0.0, 0.0, 1.0], (len(ground), 1)) if normals is None else normals,
    )


def moved(T_a_b: Transform, one: Description) -> Description:
    return scan(
        geometry.apply(T_a_b, one.means),
        geometry.apply(T_a_b, one.ground_points),
        one.ground_normals @ T_a_b[:3, :3].T,
    )


def flat_ground(half_m: float = 20.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-half_m, half_m, 4.0), np.arange(-half_m, half_m, 4.0))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.7)])


def trees(seed: int, count: int = 12) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-30, -30, -1.5], [30, 30, 1.0], size=(count, 3))


def all_pairs(source: Description, target: Description) -> Correspondences:
    return next(putative(source, target, config=SegregatorConfig()))


def align(source: Description, target: Description, T_start: Transform, config: SegregatorConfig = CONFIG):
    found = align_gaussians(all_pairs(source, target), source, target, T_start, config=config)
    return found if isinstance(found, Rejected) else found[1]


@pytest.mark.parametrize("ground", [flat_ground(), NO_GROUND], ids=["ground", "no ground"])
def test_an_exact_copy_is_laid_on_itself_from_a_rough_pose(ground: np.ndarray) -> None:
    source = scan(trees(0), ground)
    T_start = T_TRUE @ geometry.exp(geometry.tangent(rotation_rad=0.01, translation_m=0.15))
    target = moved(T_TRUE, source)
    score, fit = align_gaussians(all_pairs(source, target), source, target, T_start, config=CONFIG)
    assert np.allclose(fit.T_target_source, T_TRUE, atol=1e-6)
    assert fit.num_inliers == 12
    assert score == pytest.approx(12.0, abs=1e-6)
    assert fit.rms_m < 1e-6


def test_each_cluster_is_paired_at_most_once_and_with_the_nearest() -> None:
    source = scan(np.array([[0.0, 0, 0], [0.3, 0, 0], [9.0, 0, 0]]), NO_GROUND)
    target = scan(np.array([[0.1, 0, 0], [9.2, 0, 0], [9.1, 0, 0], [50.0, 0, 0]]), NO_GROUND)
    correspondences = all_pairs(source, target)
    rows = nearest_pairs(correspondences, np.eye(4))
    pairs = list(zip(correspondences.source_index[rows], correspondences.target_index[rows], strict=True))
    assert pairs == [(0, 0), (2, 2)]


def test_pairs_beyond_the_gate_are_none() -> None:
    sigma = np.sqrt(2 * descent.CENTROID_NOISE_M**2 + 2 * (descent.CENTROID_NOISE_SHARE * 0.3) ** 2)
    source = scan(np.zeros((1, 3)), NO_GROUND)
    for sigmas, expected in [(3.3, 1), (3.4, 0)]:  # the gate is at sqrt(11.345) = 3.37
        target = scan(np.array([[sigmas * sigma, 0, 0]]), NO_GROUND)
        assert len(nearest_pairs(all_pairs(source, target), np.eye(4))) == expected


def test_ground_is_paired_with_the_nearest_patch_within_reach() -> None:
    here = scan(trees(0), np.array([[0.0, 0, 0], [100.0, 0, 0]]))
    there = scan(trees(0), np.array([[3.0, 0, 0], [-1.0, 0, 0], [200.0, 0, 0]]))
    points, centres, _ = nearest_planes(here, there, np.eye(4))
    assert points.tolist() == [[0, 0, 0]]
    assert centres.tolist() == [[-1, 0, 0]]


def test_swapping_the_scans_inverts_the_pose() -> None:
    rng = np.random.default_rng(1)
    source = scan(trees(1), flat_ground() + rng.normal(scale=0.05, size=flat_ground().shape))
    target = moved(T_TRUE, scan(trees(1) + rng.normal(scale=0.1, size=(12, 3)), flat_ground()))
    forth = align(source, target, T_TRUE)
    back = align(target, source, geometry.inverse(T_TRUE))
    # The ground is paired at the start of the last round: poses agree to what one round still moves.
    assert np.allclose(forth.T_target_source @ back.T_target_source, np.eye(4), atol=2e-4)
    assert forth.num_inliers == back.num_inliers == 12


def test_ground_levels_what_clusters_of_uncertain_height_tilt() -> None:
    rng = np.random.default_rng(2)
    heights = rng.normal(scale=0.4, size=(12, 1)) * [0.0, 0.0, 1.0]
    errors = []
    for ground in (NO_GROUND, flat_ground()):
        source = scan(trees(2), ground, spread_m=1.0)
        target = moved(T_TRUE, scan(trees(2) + heights, ground))
        fit = align(source, target, T_TRUE)
        errors.append(geometry.angle(geometry.inverse(T_TRUE) @ fit.T_target_source))
    assert errors[1] < 0.3 * errors[0]


def test_shared_noise_bounds_what_the_information_claims_of_the_translation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = scan(trees(4, count=60), flat_ground())
    sigma = {}
    for noise_m in (0.0, 0.5):
        monkeypatch.setattr(gaussians, "SHARED_NOISE", np.diag([0.0, 0.0, 0.0, *[noise_m**2] * 3]))
        fit = align(source, source, np.eye(4), SegregatorConfig())
        sigma[noise_m] = np.sqrt(np.diagonal(np.linalg.inv(fit.information)))
    assert np.allclose(sigma[0.5][:3], sigma[0.0][:3], rtol=1e-6)
    assert np.allclose(sigma[0.5][3:], np.hypot(sigma[0.0][3:], 0.5), rtol=1e-6)


def test_far_fewer_pairs_than_a_clique_needs_are_rejected() -> None:
    source = scan(trees(3), flat_ground())
    elsewhere = geometry.transform(np.eye(3), [500.0, 0.0, 0.0])
    assert align(source, source, elsewhere).reason is RejectReason.TOO_FEW_INLIERS


def test_clusters_on_one_vertical_line_leave_the_pose_open() -> None:
    pole = np.array([[5.0, 5.0, z] for z in (-1.0, 1.0, 3.0, 5.0)])
    source = scan(pole, flat_ground())
    assert align(source, source, np.eye(4)).reason is RejectReason.DEGENERATE


def test_a_row_of_trees_leaves_the_pose_open_but_for_the_ground() -> None:
    row = np.array([[x, 5.0, -1.0] for x in (-20.0, -8.0, 3.0, 15.0)])
    assert align(scan(row, NO_GROUND), scan(row, NO_GROUND), np.eye(4)).reason is RejectReason.DEGENERATE
    assert isinstance(align(scan(row, flat_ground()), scan(row, flat_ground()), np.eye(4)), Registration)
