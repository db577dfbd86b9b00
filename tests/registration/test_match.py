"""Matching two descriptions: known answers, symmetries, failures, real scans."""

import math
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.types import Description, Label, Registration, Rejected, RejectReason, Transform
from segslam.registration.segregator import descent, gaussians
from segslam.registration.segregator.match import hypotheses, match, upward, vertical

MATCH = import_module("segslam.registration.segregator.match")
"""The module; the package has a function of this name."""

NO_ROWS = np.empty((0, 3))
T_IDENTITY = np.eye(4)
T_TRUE = geometry.transform(geometry.yaw(2.2), [7.0, -12.0, 0.4])


def description(
    means: np.ndarray,
    covariances: np.ndarray,
    classes: np.ndarray,
    ground_points: np.ndarray = NO_ROWS,
    ground_normals: np.ndarray = NO_ROWS,
) -> Description:
    return Description(
        means=means,
        covariances=covariances,
        classes=classes.astype(np.uint8),
        sizes=np.full(len(means), 50),
        feature_points=np.empty((0, 3)),
        feature_covariances=np.empty((0, 3, 3)),
        feature_classes=np.empty(0, np.uint8),
        feature_descriptors=np.empty((0, 33)),
        ground_points=ground_points,
        ground_normals=ground_normals,
    )


def street(seed: int, count: int = 16) -> Description:
    rng = np.random.default_rng(seed)
    means = rng.uniform([-40, -40, -1], [40, 40, 1], size=(count, 3))
    roots = rng.normal(scale=0.4, size=(count, 3, 3))
    return description(means, roots @ np.swapaxes(roots, 1, 2), rng.choice([Label.CAR, Label.TRUNK], count))


def moved(T_a_b: Transform, scan: Description) -> Description:
    R = T_a_b[:3, :3]
    return description(
        geometry.apply(T_a_b, scan.means),
        R @ scan.covariances @ R.T,
        scan.classes,
        geometry.apply(T_a_b, scan.ground_points),
        scan.ground_normals @ R.T,
    )


def grounded(scan: Description, slope: float = 0.02) -> Description:
    """The same on gently sloping ground, in patches of 4 m."""
    x, y = np.meshgrid(np.arange(-30.0, 30.0, 4.0), np.arange(-30.0, 30.0, 4.0))
    points = np.column_stack([x.ravel(), y.ravel(), slope * x.ravel() - 1.7])
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(1.0, slope)
    return replace(scan, ground_points=points, ground_normals=np.tile(normal, (len(points), 1)))


def on_no_ground(scan: Description) -> Description:
    return scan


Lay = Callable[[Description], Description]
LAYS = [on_no_ground, grounded]


def permuted(scan: Description, order: np.ndarray) -> Description:
    return description(
        scan.means[order], scan.covariances[order], scan.classes[order], scan.ground_points, scan.ground_normals
    )


def seen_again(scan: Description, seed: int, noise_m: float = 0.05, lost: int = 5, new: int = 6) -> Description:
    """The scan from T_TRUE: some clusters gone, others new, the rest measured with noise."""
    rng = np.random.default_rng(seed)
    kept = rng.permutation(len(scan.means))[lost:]
    old, strange = moved(T_TRUE, permuted(scan, kept)), street(seed + 1000, new)
    return description(
        np.concatenate([old.means + rng.normal(scale=noise_m, size=old.means.shape), strange.means]),
        np.concatenate([old.covariances, strange.covariances]),
        np.concatenate([old.classes, strange.classes]),
        old.ground_points,
        old.ground_normals,
    )


def disturbed(scan: Description, rng: np.random.Generator) -> Description:
    extents = np.linalg.cholesky(scan.covariances + 1e-12 * np.eye(3))
    shifts = descent.CENTROID_NOISE_M * rng.normal(size=scan.means.shape)
    shifts += descent.CENTROID_NOISE_SHARE * np.einsum("nij,nj->ni", extents, rng.normal(size=scan.means.shape))
    return description(scan.means + shifts, scan.covariances, scan.classes)


def error(registration: Registration | Rejected, T_target_source: Transform) -> tuple[float, float]:
    """Metres and degrees."""
    assert isinstance(registration, Registration)
    difference = registration.T_target_source @ geometry.inverse(T_target_source)
    return geometry.distance(difference), np.degrees(geometry.angle(difference))


@pytest.mark.parametrize("seed", range(5))
def test_exact_copy_gives_the_exact_pose_and_all_clusters_as_inliers(seed: int) -> None:
    scan = street(seed)
    registration = match(scan, moved(T_TRUE, scan), config=SegregatorConfig())
    assert np.allclose(registration.T_target_source, T_TRUE, atol=1e-9)
    assert registration.num_inliers == len(scan.means)
    assert registration.rms_m < 1e-9


@pytest.mark.parametrize("gate", ["invariant", "lengths"])
@pytest.mark.parametrize("seed", range(5))
def test_noise_and_strangers_leave_the_pose_within_the_noise(gate: str, seed: int) -> None:
    scan = street(seed)
    registration = match(scan, seen_again(scan, seed), config=SegregatorConfig(gate=gate))
    metres, degrees = error(
        registration, T_TRUE
    )  # 11 points of 0.05 m noise over 40 m: 0.05 m / sqrt(11), 0.04 degrees
    assert metres < 0.08
    assert degrees < 0.3


@pytest.mark.parametrize("lay", LAYS)
def test_swapping_the_scans_inverts_the_pose(lay: Lay) -> None:
    source = lay(street(3))
    target = seen_again(source, 3)
    forth = match(source, target, config=SegregatorConfig())
    back = match(target, source, config=SegregatorConfig())
    assert np.allclose(forth.T_target_source @ back.T_target_source, np.eye(4), atol=1e-4)  # where iterations stop
    assert forth.num_inliers == back.num_inliers


@pytest.mark.parametrize("lay", LAYS)
def test_moving_the_target_multiplies_the_pose_on_the_left(lay: Lay) -> None:
    source = lay(street(4))
    target = seen_again(source, 4)
    T_new_old = geometry.exp(geometry.tangent(rotation_rad=[0.3, -0.2, 1.0], translation_m=[5.0, 6.0, 7.0]))
    before = match(source, target, config=SegregatorConfig())
    after = match(source, moved(T_new_old, target), config=SegregatorConfig())
    assert np.allclose(after.T_target_source, T_new_old @ before.T_target_source, atol=1e-6)


@pytest.mark.parametrize("lay", LAYS)
def test_order_of_clusters_changes_nothing(lay: Lay) -> None:
    source = lay(street(5))
    target = seen_again(source, 5)
    rng = np.random.default_rng(0)
    before = match(source, target, config=SegregatorConfig())
    after = match(
        permuted(source, rng.permutation(len(source.means))),
        permuted(target, rng.permutation(len(target.means))),
        config=SegregatorConfig(),
    )
    assert np.allclose(after.T_target_source, before.T_target_source, atol=1e-9)


def test_same_input_gives_the_same_bits() -> None:
    source = street(6)
    target = seen_again(source, 6)
    poses = [match(source, target, config=SegregatorConfig()).T_target_source for _ in range(3)]
    assert np.array_equal(poses[0], poses[1])
    assert np.array_equal(poses[0], poses[2])


def test_first_hypothesis_is_the_match() -> None:
    source = street(7)
    target = seen_again(source, 7)
    ranked = hypotheses(source, target, config=SegregatorConfig())
    best = match(source, target, config=SegregatorConfig())
    assert np.array_equal(ranked[0].T_target_source, best.T_target_source)


def test_information_predicts_the_scatter_of_the_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """Centroids of both scans are moved by the noise that the model claims; xi^T information xi is then chi-square."""
    monkeypatch.setattr(gaussians, "SHARED_NOISE", np.zeros((6, 6)))
    config = SegregatorConfig()
    scan = street(8)
    moved_scan = moved(T_TRUE, scan)
    errors = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        registration = match(disturbed(scan, rng), disturbed(moved_scan, rng), config=config)
        xi = geometry.log(geometry.inverse(T_TRUE) @ registration.T_target_source)
        errors.append(xi @ registration.information @ xi)
    # 6 for least squares; Cauchy's weights give away some information, and a few clusters fail the gate.
    assert 4.0 < np.mean(errors) < 8.0


def test_no_clusters_are_too_few_correspondences() -> None:
    empty = street(0, count=0)
    for source, target in [(empty, empty), (street(1), empty), (empty, street(1))]:
        outcome = match(source, target, config=SegregatorConfig())
        assert outcome.reason is RejectReason.TOO_FEW_CORRESPONDENCES


def test_classes_that_do_not_meet_are_too_few_correspondences() -> None:
    scan = street(2)
    other = description(scan.means, scan.covariances, np.full(len(scan.means), Label.POLE))
    assert match(scan, other, config=SegregatorConfig()).reason is RejectReason.TOO_FEW_CORRESPONDENCES


def test_scans_of_different_places_have_a_small_clique() -> None:
    outcome = match(street(10), street(11), config=SegregatorConfig(min_clique=7))
    assert outcome.reason is RejectReason.SMALL_CLIQUE


@pytest.mark.parametrize("lay", LAYS)
def test_clusters_all_in_one_spot_give_no_pose(lay: Lay) -> None:
    scan = street(17)
    spot = lay(description(np.zeros_like(scan.means), scan.covariances, scan.classes))
    assert isinstance(match(spot, spot, config=SegregatorConfig()), Rejected)


@pytest.mark.parametrize("lay", LAYS)
def test_clusters_whose_place_is_no_number_are_as_if_not_there(lay: Lay) -> None:
    scan = lay(street(18))
    broken = replace(scan, means=np.where(np.arange(16)[:, None] < 4, np.nan, scan.means))
    registration = match(broken, moved(T_TRUE, scan), config=SegregatorConfig())
    assert np.allclose(registration.T_target_source, T_TRUE, atol=1e-6)
    assert registration.num_inliers == 12


def test_clusters_on_a_line_are_degenerate_but_for_the_ground() -> None:
    scan = street(12)
    row = description(scan.means * [1.0, 0.0, 0.0], scan.covariances, scan.classes)
    assert match(row, row, config=SegregatorConfig()).reason is RejectReason.DEGENERATE
    on_ground = grounded(row)
    registration = match(on_ground, moved(T_TRUE, on_ground), config=SegregatorConfig())
    assert np.allclose(registration.T_target_source, T_TRUE, atol=1e-6)


def test_ground_keeps_a_level_scene_from_being_turned_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clusters on one level fit their mirror image upside down as well as themselves."""
    scan = street(13)
    level = grounded(description(scan.means * [1.0, 1.0, 0.0], scan.covariances, scan.classes), slope=0.0)
    monkeypatch.setattr(MATCH, "CERTAIN_INLIERS", 1000)
    for registration in hypotheses(level, moved(T_TRUE, level), config=SegregatorConfig()):
        assert (registration.T_target_source @ geometry.inverse(T_TRUE))[2, 2] > 0.9


def test_ground_in_one_scan_alone_does_not_align_the_verticals() -> None:
    scan = street(13)
    assert error(match(grounded(scan, slope=0.0), moved(T_TRUE, scan), config=SegregatorConfig()), T_TRUE)[0] < 0.1


def test_repeated_structure_gives_several_different_hypotheses_with_the_truth_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A row of identical trees matches itself when shifted by one tree; one more object makes the pose unique."""
    trees = np.array(
        [[8.0 * k, 0.0, 0.0] for k in range(6)] + [[8.0 * k, 9.0, 0.0] for k in range(6)] + [[3.0, 4.0, 0.0]]
    )
    scan = grounded(description(trees, np.tile(0.01 * np.eye(3), (13, 1, 1)), np.full(13, Label.TRUNK)), slope=0.0)
    monkeypatch.setattr(MATCH, "CERTAIN_INLIERS", 1000)
    ranked = hypotheses(scan, moved(T_TRUE, scan), config=SegregatorConfig())
    assert np.allclose(ranked[0].T_target_source, T_TRUE, atol=1e-6)
    for k, one in enumerate(ranked):
        for other in ranked[:k]:
            assert error(one, other.T_target_source) > (0.5, 2.0) or error(one, other.T_target_source)[1] > 2.0


def with_features(scan: Description, T_a_b: Transform = T_IDENTITY) -> Description:
    """Forty key points around the scan, each unlike the others."""
    rng = np.random.default_rng(99)
    return replace(
        scan,
        feature_points=geometry.apply(T_a_b, rng.uniform([-30, -30, 0], [30, 30, 6], size=(40, 3))),
        feature_covariances=np.tile(0.1 * np.eye(3), (40, 1, 1)),
        feature_classes=np.full(40, Label.BUILDING, np.uint8),
        feature_descriptors=rng.uniform(size=(40, 33)),
    )


def test_features_help_only_where_clusters_leave_the_pose_uncertain() -> None:
    for count, members in [(4, 44), (20, 20)]:
        scan = street(15, count)
        target = with_features(moved(T_TRUE, scan), T_TRUE)
        registration = match(with_features(scan), target, config=SegregatorConfig())
        assert np.allclose(registration.T_target_source, T_TRUE, atol=1e-6)
        assert registration.num_inliers == members


def test_features_wanted_always_join_from_the_start_and_never_not_at_all() -> None:
    scan = street(16, count=20)
    source, target = with_features(scan), with_features(moved(T_TRUE, scan), T_TRUE)
    always, never = (match(source, target, config=SegregatorConfig(features=when)) for when in ("always", "never"))
    assert always.num_correspondences == never.num_correspondences + 40


@pytest.mark.parametrize("solver", ["gaussians", "joint", "decoupled"])
@pytest.mark.parametrize("rotation", ["full", "yaw"])
def test_every_solver_finds_the_pose(solver: str, rotation: str) -> None:
    source = street(14)
    config = SegregatorConfig(solver=solver, rotation=rotation)
    metres, degrees = error(match(source, seen_again(source, 14), config=config), T_TRUE)
    assert metres < 0.15
    assert degrees < 0.6


def test_little_ground_turns_the_vertical_little_and_much_ground_decides_it() -> None:
    leaning = np.array([math.sin(math.radians(20.0)), 0.0, math.cos(math.radians(20.0))])
    turns_deg = [math.degrees(math.acos(min(_vertical_of(np.tile(leaning, (n, 1)))[2], 1.0))) for n in (0, 2, 25)]
    assert turns_deg[0] == 0.0
    assert turns_deg[1] == pytest.approx(7.3, abs=0.5), "5 degrees of tilt against 13 degrees in two patches"
    assert turns_deg[2] > 19.0, "as of a sensor in the hand"


def test_patches_of_slopes_and_walls_do_not_turn_the_vertical() -> None:
    rng = np.random.default_rng(4)
    normals = np.column_stack([rng.normal(scale=0.02, size=(16, 2)), np.ones(16)])
    normals[:5] = [0.8, 0.3, 0.5]
    up = _vertical_of(normals / np.linalg.norm(normals, axis=1, keepdims=True))
    assert math.degrees(math.acos(up[2])) < 1.5, "the mean of the normals is off by 16 degrees"


def test_four_walls_that_are_labelled_as_ground_show_no_vertical() -> None:
    normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]] * 2)
    np.testing.assert_array_equal(_vertical_of(normals), [0.0, 0.0, 1.0])
    assert upward(_ground_of(normals)) is None


def _vertical_of(normals: np.ndarray) -> np.ndarray:
    return vertical(_ground_of(normals))


def _ground_of(normals: np.ndarray) -> Description:
    return description(NO_ROWS, np.empty((0, 3, 3)), np.empty(0), np.zeros((len(normals), 3)), normals)
