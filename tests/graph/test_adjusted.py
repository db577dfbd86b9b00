import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.graph import Edge, PoseGraph

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
