"""Gauss-Newton over centroids and planes, against plain NumPy and a general minimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from segslam.core import geometry
from segslam.core.types import Transform
from segslam.registration.segregator.descent import (
    CENTROID_NOISE_M,
    CENTROID_NOISE_SHARE,
    GATE,
    GROUND_NOISE_M,
    GROUND_SLOPE,
    GROUND_WEIGHT,
    MAX_STEPS,
    STEP_DONE,
    least_cost,
    squared_distances,
)

T_TRUE = geometry.transform(geometry.yaw(0.8), [4.0, -7.0, 0.5])


def random_covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    roots = rng.normal(scale=0.5, size=(count, 3, 3))
    return roots @ np.swapaxes(roots, 1, 2)


def scene(seed: int, *, centroid_noise_m: float = 0.1, plane_noise_m: float = 0.05) -> dict[str, np.ndarray]:
    """Matched centroids, and planes of gently sloping ground both ways, as seen from T_TRUE with noise."""
    rng = np.random.default_rng(seed)
    source = rng.uniform(-30, 30, size=(12, 3))
    target = geometry.apply(T_TRUE, source) + rng.normal(scale=centroid_noise_m, size=(12, 3))
    patches = {"source": rng.uniform(-30, 30, size=(9, 3)), "target": rng.uniform(-30, 30, size=(7, 3))}
    normals = {side: rng.normal([0, 0, 5], 0.5, size=points.shape) for side, points in patches.items()}
    normals = {side: vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for side, vectors in normals.items()}
    shift = {side: rng.normal(scale=plane_noise_m, size=points.shape) for side, points in patches.items()}
    T_back = geometry.inverse(T_TRUE)
    return {
        "source": source,
        "target": target,
        "source_covariances": random_covariances(rng, 12),
        "target_covariances": random_covariances(rng, 12),
        "source_patches": patches["source"],
        "target_planes": geometry.apply(T_TRUE, patches["source"]) + shift["source"],
        "target_normals": normals["source"] @ T_TRUE[:3, :3].T,
        "target_patches": patches["target"],
        "source_planes": geometry.apply(T_back, patches["target"]) + shift["target"],
        "source_normals": normals["target"] @ T_back[:3, :3].T,
    }


def solve(s: dict[str, np.ndarray], T_start: Transform) -> tuple[Transform, np.ndarray]:
    return least_cost(*s.values(), T_start)


def plain_squared(s: dict[str, np.ndarray], T_target_source: Transform) -> np.ndarray:
    R = T_target_source[:3, :3]
    gaps = s["target"] - geometry.apply(T_target_source, s["source"])
    covariances = CENTROID_NOISE_SHARE**2 * (
        R @ s["source_covariances"] @ R.T + s["target_covariances"]
    ) + 2 * CENTROID_NOISE_M**2 * np.eye(3)
    return np.einsum("ni,nij,nj->n", gaps, np.linalg.inv(covariances), gaps)


def plane_cost(points: np.ndarray, centres: np.ndarray, normals: np.ndarray) -> float:
    gaps = np.sum(normals * (centres - points), axis=1)
    variances = GROUND_NOISE_M**2 + GROUND_SLOPE**2 * np.sum((centres - points) ** 2, axis=1)
    return float(np.sum(GROUND_WEIGHT * np.log1p(gaps**2 / variances)))


def plain_cost(s: dict[str, np.ndarray], T_target_source: Transform) -> float:
    forth = geometry.apply(T_target_source, s["source_patches"])
    back = geometry.apply(geometry.inverse(T_target_source), s["target_patches"])
    return (
        float(np.sum(3.0 * np.log1p(plain_squared(s, T_target_source) / 3.0)))
        + plane_cost(forth, s["target_planes"], s["target_normals"])
        + plane_cost(back, s["source_planes"], s["source_normals"])
    )


@pytest.mark.parametrize("seed", range(4))
def test_squared_distances_are_those_of_plain_numpy(seed: int) -> None:
    s = scene(seed, centroid_noise_m=0.6)
    T_near = T_TRUE @ geometry.exp(geometry.tangent(rotation_rad=0.01, translation_m=0.1))
    found = squared_distances(s["source"], s["target"], s["source_covariances"], s["target_covariances"], T_near)
    expected = plain_squared(s, T_near)
    near = np.isfinite(found)
    assert near.sum() > 6
    assert np.allclose(found[near], expected[near])
    assert np.all(expected[~near] > GATE)


@pytest.mark.parametrize("seed", range(4))
def test_without_noise_the_true_pose_comes_back_from_a_metre_and_five_degrees_away(seed: int) -> None:
    s = scene(seed, centroid_noise_m=0.0, plane_noise_m=0.0)
    T_start = T_TRUE @ geometry.exp(geometry.tangent(rotation_rad=[0.03, -0.03, 0.07], translation_m=[0.6, -0.6, 0.3]))
    T_found, _ = solve(s, T_start)
    assert np.allclose(T_found, T_TRUE, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_no_general_minimiser_finds_a_lower_cost_nearby(seed: int) -> None:
    """The planes' variances are held fixed in a step, so that the cost is left flat to 1 part in 1,000 only."""
    s = scene(seed)
    T_found, _ = solve(s, T_TRUE)
    best = minimize(lambda xi: plain_cost(s, T_found @ geometry.exp(xi)), np.zeros(6), method="BFGS", tol=1e-10)
    assert plain_cost(s, T_found) <= best.fun * 1.001
    assert np.abs(best.x).max() < 2e-3


def test_information_is_the_curvature_of_the_cost_where_residuals_are_small() -> None:
    s = scene(0, centroid_noise_m=0.0, plane_noise_m=0.0)
    T_found, information = solve(s, T_TRUE)
    step = 1e-3
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = step
        curvature = (plain_cost(s, T_found @ geometry.exp(xi)) + plain_cost(s, T_found @ geometry.exp(-xi))) / step**2
        assert curvature == pytest.approx(2.0 * information[axis, axis], rel=0.05)  # flatter by Cauchy's 4th order


def test_an_outlier_moves_the_pose_less_than_the_noise_does() -> None:
    s = scene(1)
    T_clean, _ = solve(s, T_TRUE)
    s["target"] = s["target"].copy()
    s["target"][0] += [3.0, -2.0, 1.0]
    T_found, _ = solve(s, T_TRUE)
    assert geometry.distance(geometry.inverse(T_clean) @ T_found) < 0.1


def test_centroids_alone_are_enough_and_no_ground_is_no_error() -> None:
    s = scene(2, centroid_noise_m=0.0)
    none = {name: np.empty((0, 3)) for name in list(s)[4:]}
    T_found, information = solve({**s, **none}, T_TRUE)
    assert np.allclose(T_found, T_TRUE, atol=1e-9)
    assert np.all(np.linalg.eigvalsh(information) > 0)


def plain_rows(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Jacobian of the distances of points from planes: [point x normal, normal]."""
    return np.hstack([np.cross(points, normals), normals])


def plain_weights(gaps: np.ndarray, points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    variances = GROUND_NOISE_M**2 + GROUND_SLOPE**2 * np.sum((points - centres) ** 2, axis=1)
    return GROUND_WEIGHT / (variances + gaps**2)


def plain_least_cost(s: dict[str, np.ndarray], T: Transform) -> tuple[Transform, np.ndarray]:
    """`least_cost` in NumPy: all residuals and Jacobians of a step at once."""
    for _ in range(MAX_STEPS):
        R = T[:3, :3]
        T_back = geometry.inverse(T)
        errors = geometry.apply(T_back, s["target"]) - s["source"]
        spread = s["source_covariances"] + R.T @ s["target_covariances"] @ R
        W = np.linalg.inv(CENTROID_NOISE_SHARE**2 * spread + 2 * CENTROID_NOISE_M**2 * np.eye(3))
        W /= 1.0 + np.einsum("ni,nij,nj->n", errors, W, errors)[:, None, None] / 3.0
        J = np.tile(np.hstack([np.zeros((3, 3)), np.eye(3)]), (len(errors), 1, 1))
        J[:, :, :3] = np.cross(s["source"][:, None], np.eye(3))
        H = np.einsum("nur,nuv,nvc->rc", J, W, J)
        g = np.einsum("nur,nuv,nv->r", J, W, errors)
        centres, normals = geometry.apply(T_back, s["target_planes"]), s["target_normals"] @ R
        points = geometry.apply(T_back, s["target_patches"])
        forth = np.sum(normals * (centres - s["source_patches"]), axis=1)
        back = np.sum(s["source_normals"] * (points - s["source_planes"]), axis=1)
        rows = np.vstack([plain_rows(s["source_patches"], normals), plain_rows(points, s["source_normals"])])
        weights = np.hstack(
            [plain_weights(forth, s["source_patches"], centres), plain_weights(back, points, s["source_planes"])]
        )
        H += rows.T @ (weights[:, None] * rows)
        g += rows.T @ (weights * np.hstack([forth, back]))
        step = np.linalg.solve(H + 1e-9 * np.eye(6), g)
        T = T @ geometry.transform(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
        if np.abs(step).max() < STEP_DONE:
            break
    return T, H


@pytest.mark.parametrize("seed", range(4))
def test_pose_and_information_are_those_of_plain_numpy(seed: int) -> None:
    s = scene(seed, centroid_noise_m=0.3)
    T_start = T_TRUE @ geometry.exp(geometry.tangent(rotation_rad=[0.03, -0.03, 0.07], translation_m=[0.6, -0.6, 0.3]))
    T_found, information = solve(s, T_start)
    T_plain, H = plain_least_cost(s, T_start)
    np.testing.assert_allclose(T_found, T_plain, atol=1e-9)
    np.testing.assert_allclose(information, H, rtol=1e-6, atol=1e-6 * np.abs(H).max())
