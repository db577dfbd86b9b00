import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.graph import Edge, PoseGraph
from segslam.graph.adjusted import without_shared_rotation

NUM, STEP_M = 120, 2.0
INFORMATION = np.diag(geometry.tangent(rotation_rad=1e-3, translation_m=0.02) ** -2.0)


def noisy(rng: np.random.Generator, information: np.ndarray, factor: float) -> np.ndarray:
    return geometry.exp(factor * np.linalg.solve(np.linalg.cholesky(information).T, rng.standard_normal(6)))


@pytest.mark.parametrize(("odometry", "measured"), [(1.0, 1.0), (0.2, 2.0), (3.0, 0.8)])
def test_the_noise_of_odometry_and_of_measurements_is_estimated(odometry: float, measured: float) -> None:
    rng = np.random.default_rng(1)
    config = GraphConfig()
    made, T_odom = PoseGraph(config), np.eye(4)
    T_step = geometry.transform(np.eye(3), [STEP_M, 0.0, 0.0])
    sigmas = geometry.tangent(
        rotation_rad=np.radians(config.odometry_sigma_deg) * np.sqrt(STEP_M),
        translation_m=config.odometry_sigma_m * np.sqrt(STEP_M),
    )
    for keyframe_id in range(NUM):
        made.add_keyframe(keyframe_id, T_odom, STEP_M * keyframe_id)
        T_odom = T_odom @ T_step @ noisy(rng, np.diag(sigmas**-2.0), odometry)
    made.finish()
    edges = [
        Edge(older, older + step, np.linalg.matrix_power(T_step, step) @ noisy(rng, INFORMATION, measured), INFORMATION)
        for step in (5, 10)
        for older in range(NUM - step)
    ]
    _, found = made.adjust(edges)
    assert found == pytest.approx((odometry, measured), rel=0.25)


def test_a_rotation_that_all_motions_share_is_removed_and_a_break_keeps_its_motion() -> None:
    """Motions pitch by 5 mdeg/m, measurements 5 and 10 keyframes apart do not; one of those far apart is wrong."""
    T_step = geometry.transform(np.eye(3), [STEP_M, 0.0, 0.0])
    pitched = T_step @ geometry.exp(np.array([0.0, np.radians(5e-3) * STEP_M, 0.0, 0.0, 0.0, 0.0]))
    broken = 30
    odometry = [Edge(one, one + 1, pitched, INFORMATION * (1e-9 if one == broken else 1.0)) for one in range(NUM - 1)]
    measured = [
        Edge(older, older + step, np.linalg.matrix_power(T_step, step), INFORMATION)
        for step in (5, 10)
        for older in range(NUM - step)
    ]
    far = Edge(0, 100, geometry.exp(np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])), INFORMATION)
    found = without_shared_rotation(odometry, [*measured, far], within=10)
    for one, (before, after) in enumerate(zip(odometry, found, strict=True)):
        np.testing.assert_allclose(after.T_a_b, before.T_a_b if one == broken else T_step, atol=1e-4)
        assert geometry.angle(after.T_a_b) == pytest.approx(geometry.angle(before.T_a_b) if one == broken else 0.0)
    for kept in (without_shared_rotation(odometry, [far], within=10), without_shared_rotation(odometry, measured, 0)):
        np.testing.assert_allclose([edge.T_a_b for edge in kept], [edge.T_a_b for edge in odometry], atol=1e-12)
