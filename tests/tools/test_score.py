"""The score in the shadow of the gates: what patches show, and what is learnt from it."""

import numpy as np
import pytest
from segslam.verification.gates import Observed
from tools.benchmarks.score.evidence import BINS, evidence

from segslam.core import geometry
from segslam.core.config import Config
from segslam.registration.prepared import prepare_observed
from tools.benchmarks.score.ratio import Pair, Pose, Run, Score, log_ratios, mean_ratio

CONFIG = Config()


def _room(seed: int, length_m: float = 16.0) -> Observed:
    """A scan from the middle of a room 8 m wide, with a pillar on one side; 1 cm of noise."""
    rng = np.random.default_rng(seed)
    side, end, ground = (rng.uniform(-1.0, 1.0, size=(4000, 3)) for _ in range(3))
    side *= [length_m / 2, 1.0, 1.5]
    side[:, 1] = np.sign(side[:, 1]) * 4.0
    end *= [1.0, 4.0, 1.5]
    end[:, 0] = np.sign(end[:, 0]) * length_m / 2
    ground *= [length_m / 2, 4.0, 0.0]
    pillar = rng.uniform(-1.0, 1.0, size=(800, 3)) * [0.6, 0.6, 1.5]
    nearest = np.abs(pillar[:, :2]).argmax(axis=1)
    rows = np.arange(len(pillar))
    pillar[rows, nearest] = np.sign(pillar[rows, nearest]) * 0.6
    points = np.concatenate([side, end, ground - np.array([0.0, 0.0, 1.5]), pillar + np.array([3.0, 2.0, 0.0])])
    points += rng.normal(scale=0.01, size=points.shape)
    return prepare_observed(points.astype(np.float32), np.zeros(len(points), np.uint8), config=CONFIG)


def _shown(T_target_source: np.ndarray) -> dict[str, float]:
    """Shares of the patches of standing surfaces, by what they show."""
    standing = evidence(_room(1), _room(2), T_target_source, config=CONFIG.verify)[0]
    return dict(zip(BINS, standing / standing.sum(), strict=True))


def test_at_the_true_pose_patches_lie_on_the_surfaces_of_the_other_scan() -> None:
    shown = _shown(np.eye(4))
    assert shown["in free space"] < 0.02
    assert sum(share for name, share in shown.items() if name.startswith("facing")) > 0.9


def test_patches_that_lie_where_the_other_scan_saw_through_are_in_free_space() -> None:
    """Turned by 90 degrees, the ends of the room stand in its middle, or beyond its walls, out of sight."""
    shown = _shown(geometry.transform(geometry.yaw(np.pi / 2), 0.0))
    assert shown["in free space"] > 0.2
    assert shown["in free space"] > 10 * _shown(np.eye(4))["in free space"]


def test_what_is_out_of_sight_or_out_of_range_counts_for_nothing() -> None:
    far = geometry.transform(np.eye(3), [500.0, 0.0, 0.0])
    assert evidence(_room(1), _room(2), far, config=CONFIG.verify).sum() == 0.0


def test_the_evidence_is_the_same_in_both_directions() -> None:
    T_target_source = geometry.transform(geometry.yaw(0.1), [0.2, 0.1, 0.0])
    forth = evidence(_room(1), _room(2), T_target_source, config=CONFIG.verify)
    back = evidence(_room(2), _room(1), geometry.inverse(T_target_source), config=CONFIG.verify)
    np.testing.assert_array_equal(forth, back)


def _pose(good: float, bad: float, x: float = 0.0, *, is_right: bool) -> Pose:
    """A pose with so many patches that face a surface, and so many in free space."""
    counts = np.zeros((2, len(BINS)))
    counts[0, 2], counts[0, 0] = good, bad
    return Pose(geometry.transform(np.eye(3), [x, 0.0, 0.0]), counts, is_right)


def _pair(run: Run, right: tuple[float, float] | None, wrong: tuple[float, float]) -> Pair:
    poses = [_pose(*wrong, 5.0, is_right=False)]
    if right:
        poses.append(_pose(*right, is_right=True))
    return Pair(run, right is not None, poses, "right" if right else "low_overlap", 0.1)


def _run(*, good: float) -> Run:
    return Run("here", "64", [_pose(good, 100 - good, is_right=True).counts] * 4)


STREET = _run(good=97)
TRAINED = [_pair(STREET, (95 - k, 5 + k), (60 + k, 40)) for k in range(6)]
TRAINED += [_pair(STREET, None, (55 + 2 * k, 40)) for k in range(6)]
SCORE = Score.learnt(TRAINED)


def _log_odds(pair: Pair, others: list[Pair]) -> float:
    return SCORE.log_odds(SCORE.scored(pair, others))


def test_the_ratios_say_what_right_poses_show_more_often() -> None:
    ratios = log_ratios(TRAINED)
    assert ratios[0, 2] > 0.1
    assert ratios[0, 0] < -1.0
    few, many = (mean_ratio(_pose(9 * k, k, is_right=True).counts, ratios) for k in (1, 10))
    assert few == pytest.approx(many)


def test_a_pose_that_fits_well_is_likely_unless_another_fits_as_well() -> None:
    alone, poor = _pair(STREET, (94, 6), (60, 40)), _pair(STREET, None, (60, 40))
    assert _log_odds(alone, TRAINED) > 0.0 > _log_odds(poor, TRAINED)
    rival = Pair(STREET, True, [_pose(94, 6, is_right=True), _pose(94, 6, 5.0, is_right=False)], "ambiguous", 0.1)
    assert SCORE.scored(rival, TRAINED).lead == 0.0
    assert _log_odds(rival, TRAINED) < 0.0


def test_a_pose_within_reach_of_the_best_is_no_rival() -> None:
    one, same = _pose(94, 6, is_right=True), _pose(94, 6, 0.3, is_right=True)
    assert SCORE.scored(Pair(STREET, True, [one, same], "right", 0.1), TRAINED).lead == np.inf


def test_where_impossible_pairs_fit_well_a_pose_is_less_likely() -> None:
    """The same poses, in a run whose impossible pairs fit badly, and in one where they fit nearly as well."""
    corridor = _run(good=97)
    similar = [_pair(corridor, None, (88, 12)) for _ in range(6)]
    here, there = (_pair(run, (90, 10), (70, 30)) for run in (STREET, corridor))
    assert _log_odds(there, similar) < _log_odds(here, TRAINED) - 1.0


def test_few_patches_prove_less_than_many() -> None:
    few, many = (
        Pair(STREET, True, [_pose(9 * k, k, is_right=True), _pose(8.5 * k, 1.5 * k, 5.0, is_right=False)], "right", 0.1)
        for k in (1, 40)
    )
    assert _log_odds(few, TRAINED) < _log_odds(many, TRAINED)
