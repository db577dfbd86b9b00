import numpy as np
import pytest
import small_gicp
from helpers.streets import corner, small_move

from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.types import Registration, Rejected, RejectReason
from segslam.registration import refinement
from segslam.registration.refinement import (
    UNOBSERVED,
    LightSurface,
    Surface,
    downsample,
    observability,
    refine,
    weakest_level,
)

CONFIG = RefineConfig()


def surface(points: np.ndarray) -> Surface:
    return Surface(downsample(points, config=CONFIG), CONFIG)


def _error(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    T = geometry.inverse(T_a) @ T_b
    return geometry.distance(T), float(np.degrees(geometry.angle(T)))


@pytest.mark.parametrize("seed", range(5))
def test_a_coarse_pose_is_sharpened_to_centimetres(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_target_source = geometry.transform(geometry.yaw(rng.uniform(-np.pi, np.pi)), [6.0, -3.0, 0.1])
    source = surface(geometry.apply(geometry.inverse(T_target_source), corner(rng)))
    target = surface(corner(rng))
    coarse = T_target_source @ small_move(rng, rotation_deg=0.7, translation_m=0.2)
    found = refine(source, target, coarse, config=CONFIG)
    assert isinstance(found, Registration)
    metres, degrees = _error(T_target_source, found.T_target_source)
    assert metres < 0.05, "two samplings of the same surfaces, voxels of 0.5 m: a tenth of a voxel"
    assert degrees < 0.2
    assert found.num_inliers > 0.5 * len(source)


def test_information_has_the_axes_of_the_scene() -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-20, 20, (5000, 2)), rng.normal(0, 0.01, 5000)])
    raised = floor + np.array([0.0, 0.0, 0.1])
    found = refine(surface(floor), surface(raised), np.eye(4), config=CONFIG)
    assert isinstance(found, Registration)
    assert 0.0 < found.rms_m < 0.02, "of two floors with 1 cm of noise each"
    np.testing.assert_allclose(found.information, found.information.T)
    variances = np.diag(found.information)
    assert variances[5] > 10 * max(variances[3:5]), "a floor holds height, not x and y"
    assert min(variances[:2]) > 10 * variances[2], "and roll and pitch, not yaw"


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.zeros((1000, 3)), np.full((5, 3), 1.0)])
def test_too_few_points_are_rejected(points: np.ndarray) -> None:
    few = surface(points)
    found = refine(few, few, np.eye(4), config=CONFIG)
    assert isinstance(found, Rejected)
    assert found.reason is RejectReason.TOO_FEW_POINTS


def test_scans_that_do_not_overlap_are_rejected() -> None:
    rng = np.random.default_rng(1)
    seen = surface(corner(rng))
    found = refine(seen, seen, geometry.transform(np.eye(3), [500.0, 0.0, 0.0]), config=CONFIG)
    assert isinstance(found, Rejected)
    assert found.reason is RejectReason.REFINEMENT_DIVERGED


@pytest.mark.parametrize(("coarse_m", "is_settled"), [(0.2, True), (0.6, False)])
def test_a_last_stage_that_does_not_converge_is_rejected_if_it_still_moves(
    coarse_m: float, is_settled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One iteration is never enough to converge; from near by the next one moves by millimetres."""
    rng = np.random.default_rng(0)
    T_coarse = geometry.transform(geometry.yaw(np.radians(0.7)), [coarse_m, 0.0, 0.0])
    monkeypatch.setattr(refinement, "MAX_ITERATIONS", 1)
    config = RefineConfig(correspondence_m=(0.5,))
    found = refine(surface(corner(rng)), surface(corner(rng)), T_coarse, config=config)
    if is_settled:
        assert isinstance(found, Registration)
        assert geometry.distance(found.T_target_source) < 0.05
    else:
        assert isinstance(found, Rejected)
        assert found.reason is RejectReason.REFINEMENT_DIVERGED
        assert found.detail == "still moving after 1 iterations at 0.5 m"


def _tunnel(rng: np.random.Generator) -> np.ndarray:
    """A smooth tunnel along x, 8 m wide: nothing shows where along it a scan was taken."""
    x = rng.uniform(-30.0, 30.0, (3, 8000))
    across, up = rng.uniform(-4.0, 4.0, 8000), rng.uniform(-1.7, 4.0, (2, 8000))
    sides = [
        np.column_stack([x[0], across, np.full(8000, -1.7)]),
        np.column_stack([x[1], np.full(8000, -4.0), up[0]]),
        np.column_stack([x[2], np.full(8000, 4.0), up[1]]),
    ]
    return np.concatenate(sides) + rng.normal(0.0, 0.01, (24_000, 3))


@pytest.mark.parametrize("yaw_deg", [0.0, 35.0])
def test_along_a_smooth_tunnel_the_information_is_that_of_the_search(yaw_deg: float) -> None:
    """Without that, points that slide along smooth walls claim to know the position along the tunnel to 5 cm."""
    rng = np.random.default_rng(0)
    T_target_source = geometry.transform(geometry.yaw(np.radians(yaw_deg)), 0.0)
    source = surface(geometry.apply(geometry.inverse(T_target_source), _tunnel(rng)))
    found = refine(source, surface(_tunnel(rng)), T_target_source, config=CONFIG)
    assert isinstance(found, Registration)
    axes = T_target_source[:3, :3].T @ np.eye(3)[:, :2]
    covariance = np.linalg.inv(found.information)[3:, 3:]
    sigma_m = np.sqrt(np.einsum("ik,ij,jk->k", axes, covariance, axes))
    assert sigma_m[0] >= CONFIG.correspondence_m[-1]
    assert sigma_m[1] < 0.1
    ratio, direction = observability(found.information)
    assert ratio < UNOBSERVED
    assert abs(direction @ axes[:, 0]) > 0.99


def test_a_corner_is_held_in_all_directions() -> None:
    rng = np.random.default_rng(0)
    found = refine(surface(corner(rng)), surface(corner(rng)), np.eye(4), config=CONFIG)
    assert isinstance(found, Registration)
    assert observability(found.information)[0] > UNOBSERVED
    assert np.sqrt(np.diag(np.linalg.inv(found.information))[3:]).max() < 0.1


def test_without_information_some_level_direction_is_the_weakest() -> None:
    assert np.linalg.norm(weakest_level(np.zeros((6, 6)))) == 1.0
    assert weakest_level(np.zeros((6, 6)))[2] == 0.0


@pytest.mark.data
def test_real_pairs_are_refined_to_the_reference(real_pairs) -> None:
    for pair in real_pairs.pairs:
        rng = np.random.default_rng(pair.source)
        source, target = (surface(real_pairs.points(index)) for index in (pair.source, pair.target))
        coarse = pair.T_target_source @ small_move(rng, rotation_deg=0.5, translation_m=0.15)
        found = refine(source, target, coarse, config=CONFIG)
        assert isinstance(found, Registration)
        metres, degrees = _error(pair.T_target_source, found.T_target_source)
        assert metres < 0.05, f"{pair.source} -> {pair.target}"
        assert degrees < 0.2, f"{pair.source} -> {pair.target}"


def test_a_light_surface_has_the_normals_of_a_surface() -> None:
    thinned = downsample(corner(np.random.default_rng(0)), config=CONFIG)
    light, whole = LightSurface(thinned), Surface(thinned, CONFIG)
    rows = np.array([5, 3, 200, 3])
    for asked in (rows, np.arange(len(thinned))):  # the second time some are known
        found = light.normals_at(asked)
        np.testing.assert_allclose(np.abs(np.sum(found * whole.normals[asked], axis=1)), 1.0, atol=1e-6)
    np.testing.assert_array_equal(light.nearest(thinned[rows] + 0.01)[0], rows)


def test_a_few_points_have_no_normals() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    freed = [np.full((50, 4), np.nan) for _ in range(200)]
    del freed  # memory that small_gicp takes over as it is
    np.testing.assert_array_equal(Surface(points, CONFIG).normals, np.zeros((50, 3)))


def test_a_thinned_cloud_has_the_mean_point_of_each_voxel_in_range() -> None:
    points = np.random.default_rng(0).uniform(-80, 80, (20_000, 3)).astype(np.float32)
    near = points[np.linalg.norm(points, axis=1) < refinement.MAX_RANGE_M].astype(np.float64)
    expected = small_gicp.voxelgrid_sampling(near, CONFIG.voxel_m, 1).points()[:, :3]
    found = downsample(points, config=CONFIG)
    np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)], atol=1e-5)


def test_an_empty_scan_is_prepared_in_silence(capfd: pytest.CaptureFixture[str]) -> None:
    """small_gicp writes a warning about a search tree without points."""
    empty = np.empty((0, 3))
    assert len(surface(empty)) == len(LightSurface(empty)) == 0
    assert capfd.readouterr() == ("", "")
