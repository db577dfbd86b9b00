from unittest.mock import Mock

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.graph import Edge, PoseGraph, adjusted
from segslam.graph.adjusted import weighted_edges, without_shared_rotation
from segslam.graph.edges import relinked, values_of
from segslam.graph.levenberg_marquardt import search

NUM, STEP_M = 120, 2.0
INFORMATION = np.diag(geometry.tangent(rotation_rad=1e-3, translation_m=0.02) ** -2.0)


def noisy(rng: np.random.Generator, information: np.ndarray, factor: float) -> np.ndarray:
    return geometry.exp(factor * np.linalg.solve(np.linalg.cholesky(information).T, rng.standard_normal(6)))


@pytest.mark.parametrize(("odometry", "measured"), [(1.0, 1.0), (0.2, 2.0), (3.0, 0.8)])
def test_the_noise_of_odometry_and_of_measurements_is_estimated(
    odometry: float, measured: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimate ends when it has settled, before the largest number of rounds, of two solutions each."""
    solve = Mock(side_effect=search)
    monkeypatch.setattr(adjusted, "search", solve)
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
    assert 2 <= solve.call_count < 2 * adjusted.ROUNDS


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


def test_edges_are_written_with_the_noise_that_each_kind_has() -> None:
    T_step = geometry.transform(np.eye(3), [STEP_M, 0.0, 0.0])
    broken = Edge(1, 2, T_step, 1e-9 * INFORMATION)
    odometry = [Edge(0, 1, T_step, INFORMATION), broken]
    loop, measured = Edge(0, 2, T_step @ T_step, INFORMATION), Edge(0, 2, T_step @ T_step, INFORMATION)
    values = values_of([np.linalg.matrix_power(T_step, power) for power in range(3)])
    found = weighted_edges(odometry, [loop], [measured], (2.0, 5.0), values, None)
    expected = [INFORMATION / 4.0, broken.information, INFORMATION, INFORMATION / 25.0]
    np.testing.assert_allclose([edge.information for edge in found], expected)


def test_parts_of_a_drive_are_joined_from_the_first_one_on() -> None:
    """The closure between the second and the third part comes first; it cannot place them before the second is."""
    T_step = geometry.transform(np.eye(3), [STEP_M, 0.0, 0.0])
    odometry = [Edge(row, row + 1, T_step, INFORMATION * (1e-9 if row in (1, 3) else 1.0)) for row in range(5)]
    beside = geometry.transform(np.eye(3), [0.0, 30.0, 0.0])
    closures = [Edge(2, 4, beside, INFORMATION), Edge(0, 2, beside, INFORMATION)]
    T_world = np.stack([np.linalg.matrix_power(T_step, row) for row in range(6)])
    found = relinked(odometry, closures, T_world, np.ones(2, dtype=bool))
    places = [[0, 0], [2, 0], [0, 30], [2, 30], [0, 60], [2, 60]]
    np.testing.assert_allclose(found[:, :2, 3], places, atol=1e-9)
