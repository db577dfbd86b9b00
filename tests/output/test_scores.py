"""Alignments, statistics and relative errors over a distance, compared with evo."""

import copy

import numpy as np
import pytest
from evo.core import lie_algebra, metrics
from evo.core.trajectory import PosePath3D

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.output.accuracy import Align, aligned_by, pairs_at_distance, scale_of, scores

RNG = np.random.default_rng(4)


def _drive(num: int = 400) -> Poses:
    angles = np.linspace(0, 3 * np.pi, num)
    poses = np.tile(np.eye(4), (num, 1, 1))
    for row, angle in enumerate(angles):
        poses[row] = geometry.transform(
            lie_algebra.so3_exp(np.array([0.0, 0.0, angle])),
            np.array([60 * np.cos(angle), 60 * np.sin(angle), 3 * np.sin(angle / 2)]),
        )
    return poses


def _noisy(poses: Poses, *, scale: float = 1.0) -> Poses:
    T_moved = geometry.transform(lie_algebra.so3_exp(np.array([0.1, -0.2, 0.7])), [5.0, -3.0, 1.0])
    noisy = T_moved @ poses
    noisy[:, :3, 3] = scale * noisy[:, :3, 3] + np.cumsum(RNG.normal(0, 0.02, (len(poses), 3)), axis=0)
    return noisy


def _evo(estimate: Poses, reference: Poses, align: Align) -> tuple[PosePath3D, PosePath3D]:
    true, made = PosePath3D(poses_se3=list(reference)), PosePath3D(poses_se3=list(estimate))
    moved = copy.deepcopy(made)
    if align == "first":
        moved.align_origin(true)
    elif align != "none":
        moved.align(true, correct_scale=align == "sim3")
    return moved, true


@pytest.mark.parametrize("align", ["se3", "sim3", "first", "none"])
def test_all_alignments_and_statistics_are_those_of_evo(align: Align) -> None:
    reference = _drive()
    estimate = _noisy(reference, scale=1.07)
    moved, true = _evo(estimate, reference, align)
    absolute = metrics.APE(metrics.PoseRelation.translation_part)
    absolute.process_data((true, moved))
    expected = absolute.get_all_statistics()
    found = scores(estimate, reference, align=align, rpe_distance_m=20.0)
    for name, key in (("rmse", "ate_m"), ("mean", "ate_mean_m"), ("median", "ate_median_m"), ("max", "ate_max_m")):
        assert found[key] == pytest.approx(expected[name], rel=1e-6), name
    relative = metrics.RPE(
        metrics.PoseRelation.translation_part, 20.0, metrics.Unit.meters, all_pairs=True, pairs_from_reference=True
    )
    relative.process_data((true, moved))
    assert found["rpe_over_distance_m"] == pytest.approx(relative.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    assert found["rpe_over_distance_percent"] == pytest.approx(
        5 * relative.get_statistic(metrics.StatisticsType.mean), rel=1e-6
    )
    if align == "sim3":
        assert found["scale"] == pytest.approx(1 / 1.07, rel=0.01)


def test_the_default_figures_are_those_of_the_run() -> None:
    from segslam.core.evaluation import trajectory_metrics

    reference = _drive()
    estimate = _noisy(reference)
    found, expected = scores(estimate, reference), trajectory_metrics(estimate, reference)
    assert {key: found[key] for key in expected} == pytest.approx(expected)


def test_short_drives_have_no_pairs_and_standing_ones_no_scale() -> None:
    reference = _drive(5)
    assert len(pairs_at_distance(reference, 1000.0)) == 0
    assert "rpe_over_distance_m" not in scores(reference, reference, rpe_distance_m=5000.0)
    assert scores(reference[:2], reference[:2]) == {}
    assert scale_of(np.zeros((4, 3)), np.ones((4, 3))) == 1.0
    np.testing.assert_allclose(aligned_by(reference, reference, "first"), reference, atol=1e-12)
