import numpy as np
import pytest
from kiss_icp.pybind import kiss_icp_pybind

from segslam.core.geometry import raise_beams, raising

POINTS = np.random.default_rng(2).uniform(-80, 80, (200, 3))


@pytest.mark.parametrize("angle_deg", [-0.3, 0.205, 2.0])
def test_raised_points_keep_range_and_azimuth(angle_deg: float) -> None:
    raised = raise_beams(POINTS, angle_deg)
    np.testing.assert_allclose(np.linalg.norm(raised, axis=1), np.linalg.norm(POINTS, axis=1))
    np.testing.assert_allclose(np.arctan2(*raised[:, :2].T), np.arctan2(*POINTS[:, :2].T))
    elevation = [np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (POINTS, raised)]
    np.testing.assert_allclose(np.degrees(elevation[1] - elevation[0]), angle_deg)


def test_raising_by_what_kitti_needs_is_what_kiss_icp_does() -> None:
    points = np.concatenate([[[0.0, 0.0, 5.0], [0.0, 0.0, -5.0]], POINTS])
    oracle = np.asarray(kiss_icp_pybind._correct_kitti_scan(kiss_icp_pybind._Vector3dVector(points)))
    np.testing.assert_allclose(raise_beams(points, 0.205), oracle, atol=1e-12)
    single = raise_beams(points.astype(np.float32), 0.205)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, oracle, atol=3e-5)  # 24 bits of 140 m, a few roundings


def test_no_angle_leaves_the_points_as_they_are() -> None:
    assert raise_beams(POINTS, 0.0) is POINTS


def test_lowering_undoes_raising() -> None:
    np.testing.assert_allclose(raise_beams(raise_beams(POINTS, 0.205), -0.205), POINTS, atol=1e-9)


def test_raising_is_the_derivative() -> None:
    moved = raise_beams(POINTS, float(np.degrees(1e-6)))
    np.testing.assert_allclose((moved - POINTS) / 1e-6, raising(POINTS), rtol=1e-4, atol=1e-3)


def test_a_point_nearly_straight_above_keeps_its_range() -> None:
    """The squares of its horizontal coordinates are below the smallest single-precision number."""
    above = np.array([[1e-25, 0.0, 10.0]], np.float32)
    np.testing.assert_allclose(np.linalg.norm(raise_beams(above, 0.205).astype(float)), 10.0, rtol=1e-4)
