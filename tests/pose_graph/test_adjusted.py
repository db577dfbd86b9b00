from itertools import pairwise

import numpy as np
import pytest

from segslam import geometry
from segslam.config import GraphConfig
from segslam.pose_graph import Edge, PoseGraph

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


def test_an_error_that_all_motions_have_in_common_is_taken_from_them() -> None:
    """Beams that point too low pitch every motion; measurements without that error show it."""
    made, T_odom, pitch_rad = PoseGraph(GraphConfig()), np.eye(4), 5e-4
    T_step = geometry.transform(np.eye(3), [STEP_M, 0.0, 0.0])
    rng = np.random.default_rng(2)
    slight = INFORMATION * 25.0
    T_pitched = T_step @ geometry.exp(np.array([0.0, pitch_rad, 0.0, 0.0, 0.0, 0.0]))
    for keyframe_id in range(NUM):
        made.add_keyframe(keyframe_id, T_odom, STEP_M * keyframe_id)
        T_odom = T_odom @ T_pitched @ noisy(rng, slight, 1.0)
    made.finish()
    edges = [
        Edge(older, older + 10, np.linalg.matrix_power(T_step, 10) @ noisy(rng, INFORMATION, 1.0), INFORMATION)
        for older in range(0, NUM - 10, 5)
    ]
    made.adjust(edges)
    T_world = made.T_world_keyframes
    pitches = [geometry.log(geometry.inverse(T_step) @ geometry.inverse(a) @ b)[1] for a, b in pairwise(T_world)]
    assert abs(float(np.median(pitches))) < 0.1 * pitch_rad
