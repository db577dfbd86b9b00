import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from segslam.core import geometry

SMALL = st.floats(-1.7, 1.7)  # a rotation vector below pi in length, where the logarithm is unique
LENGTH = st.floats(-100.0, 100.0)
TANGENTS = st.tuples(SMALL, SMALL, SMALL, LENGTH, LENGTH, LENGTH).map(np.array)
EXACT = 1e-9  # double precision over lengths of 100 m, with room for a few hundred roundings


@given(TANGENTS)
def test_log_undoes_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(geometry.log(geometry.exp(xi)), xi, atol=EXACT)


@given(TANGENTS)
@settings(max_examples=50)
def test_exp_is_the_matrix_exponential(xi: np.ndarray) -> None:
    x, y, z = xi[:3]
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = xi[3:]
    np.testing.assert_allclose(geometry.exp(xi), expm(generator), atol=EXACT)


@given(TANGENTS, TANGENTS)
def test_inverse_undoes_and_apply_composes(a: np.ndarray, b: np.ndarray) -> None:
    T_w_a, T_a_b = geometry.exp(a), geometry.exp(b)
    points_b = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 0.0]])
    np.testing.assert_allclose(geometry.inverse(T_w_a) @ T_w_a, np.eye(4), atol=EXACT)
    np.testing.assert_allclose(
        geometry.apply(T_w_a @ T_a_b, points_b), geometry.apply(T_w_a, geometry.apply(T_a_b, points_b)), atol=EXACT
    )


@given(TANGENTS)
def test_interpolation_meets_both_ends_and_halves_the_way(xi: np.ndarray) -> None:
    T_w_a, T_w_b = geometry.exp(xi), np.eye(4)
    np.testing.assert_allclose(geometry.interpolate(T_w_a, T_w_b, 0.0), T_w_a, atol=EXACT)
    np.testing.assert_allclose(geometry.interpolate(T_w_a, T_w_b, 1.0), T_w_b, atol=1e-7)
    middle = geometry.interpolate(T_w_a, T_w_b, 0.5)
    np.testing.assert_allclose(geometry.inverse(T_w_a) @ middle, geometry.inverse(middle) @ T_w_b, atol=1e-7)


def test_series_and_closed_form_meet_where_they_change() -> None:
    below, above = (geometry.exp(geometry.tangent(rotation_rad=[0, 0, a], translation_m=1)) for a in (0.99e-4, 1.01e-4))
    assert np.abs(below - above).max() < 3e-6


def test_a_quarter_turn_to_the_left_takes_x_to_y() -> None:
    T_a_b = geometry.transform(geometry.yaw(np.pi / 2), [1.0, 0.0, 0.0])
    np.testing.assert_allclose(geometry.apply(T_a_b, np.array([[1.0, 0.0, 0.0]])), [[1.0, 1.0, 0.0]], atol=EXACT)
    assert geometry.angle(T_a_b) == pytest.approx(np.pi / 2)
    assert geometry.distance(T_a_b) == 1.0


def test_nearest_rotation_removes_rounding_and_never_mirrors() -> None:
    rounded = np.round(geometry.yaw(0.3), 4)
    mended = geometry.nearest_rotation(rounded)
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=EXACT)
    assert np.abs(mended - rounded).max() < 1e-4
    assert np.linalg.det(geometry.nearest_rotation(np.diag([1.0, 1.0, -1.0]))) > 0


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_noise_adds_to_the_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T + 0.1 * np.eye(6)
    noise = np.diag(geometry.tangent(rotation_rad=0.2, translation_m=[1.0, 2.0, 3.0]) ** 2)
    noisier = geometry.with_covariance(np.linalg.inv(covariance), noise)
    np.testing.assert_allclose(np.linalg.inv(noisier), covariance + noise, atol=1e-9)


def test_what_was_unknown_stays_unknown_under_noise() -> None:
    known = np.diag([4.0, 0.0, 4.0, 4.0, 0.0, 4.0])
    noisier = geometry.with_covariance(known, 0.25 * np.eye(6))
    np.testing.assert_allclose(noisier, np.diag([2.0, 0.0, 2.0, 2.0, 0.0, 2.0]), atol=1e-12)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-5, 0.3, 2.0, np.pi - 1e-9, np.pi])
def test_the_angle_is_that_of_scipy(angle_rad: float) -> None:
    rng = np.random.default_rng(0)
    for axis in [*np.eye(3), *rng.normal(size=(20, 3))]:
        rotation = Rotation.from_rotvec(angle_rad * axis / np.linalg.norm(axis))
        T = geometry.transform(rotation.as_matrix(), 0.0)
        assert geometry.angle(T) == pytest.approx(angle_rad, abs=1e-14)
        np.testing.assert_allclose(geometry.exp(np.r_[angle_rad * axis / np.linalg.norm(axis), 0, 0, 0]), T, atol=1e-14)


def test_shapes_are_checked_in_tests() -> None:
    """In the first calls of each test: see `helpers.checker`."""
    points = np.zeros((3, 3))
    geometry.apply(np.eye(4), points)
    with pytest.raises(TypeCheckError):
        geometry.apply(np.eye(3), points)
