"""The table of the score is learnt from pairs whose poses are known."""

from dataclasses import replace

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import Config
from segslam.verification.patches import BINS
from segslam.verification.score import NO_OTHER, paired_lead, shipped
from tools.benchmarks.scenes import tasks
from tools.benchmarks.score.__main__ import curve, tenths
from tools.benchmarks.score.pairs import described
from tools.benchmarks.score.ratio import (
    Pair,
    Pose,
    best_of,
    calibrated,
    calibration,
    learnt,
    left_out,
    log_ratios,
    odds_of,
)

GOOD, BAD = BINS.index("near, residual 0"), BINS.index("near, free space")


def _pose(good: int, bad: int, x: float = 0.0, *, is_right: bool, is_allowed: bool = True) -> Pose:
    """A pose with so many patches that face a surface, and so many in free space."""
    shown = np.array([GOOD] * good + [BAD] * bad, np.int8)
    return Pose(geometry.transform(np.eye(3), [x, 0.0, 0.0]), shown, shown, is_right, is_allowed)


def _pair(part: str, right: int | None, wrong: int) -> Pair:
    """Poses with so many of 100 patches in free space; two wrong ones for scans of different places."""
    poses = [_pose(100 - wrong, wrong, 5.0, is_right=False)]
    if right is None:
        poses.append(_pose(99 - wrong, wrong + 1, 9.0, is_right=False))
    else:
        poses.append(_pose(100 - right, right, is_right=True))
    return Pair(part, "64", right is not None, 0.5, poses, "right" if right is not None else "improbable", 0.1)


TAUGHT = [_pair(part, 3 + k % 5, 35 + k) for part in ("street", "wood", "hall") for k in range(10)]
TAUGHT += [_pair(part, None, 2 + k % 6) for part in ("street", "wood", "hall") for k in range(10)]


def test_the_ratios_say_what_right_poses_show_more_often() -> None:
    ratios = log_ratios(TAUGHT)
    assert ratios[GOOD] > 0.1
    assert ratios[BAD] < -1.0


def test_the_best_pose_is_one_that_the_prior_allows_and_leads_over_all_others() -> None:
    table = learnt(TAUGHT)
    barred = _pose(100, 0, 9.0, is_right=False, is_allowed=False)
    one, same = _pose(94, 6, is_right=True), _pose(93, 7, 0.3, is_right=True)
    best = best_of(Pair("street", "64", True, 0.5, [one, same, barred], "right", 0.1), table)
    assert best is not None
    assert best.pose is one
    assert best.lead < 0.0
    alone = best_of(Pair("street", "64", True, 0.5, [one, same], "right", 0.1), table)
    assert alone is not None
    assert alone.lead == NO_OTHER
    assert odds_of(alone, table) > odds_of(best, table)


def test_parts_that_taught_nothing_are_separated() -> None:
    scored = left_out(TAUGHT)
    (row,) = (row for row in curve(scored) if row["wrong_accepted"] == 0)
    assert row["right_accepted"] == row["of_right"] >= 24
    assert row["of"] >= 20
    table = calibrated(learnt(TAUGHT), calibration(TAUGHT, scored))
    odds = {best.pose.is_right: odds_of(best, table) for best, _ in scored}
    assert odds[True] > 3.0 > -3.0 > odds[False]


def test_a_pose_around_which_none_was_searched_is_no_best_pose() -> None:
    table = learnt(TAUGHT)
    poor = Pair("street", "64", True, 0.5, [_pose(60, 40, is_right=False)], "improbable", 0.1)
    best = best_of(poor, table)
    assert best is not None
    assert best_of(replace(poor, is_searched=False), table) is None


def test_tenths_compare_probabilities_with_what_is_right() -> None:
    pair = _pair("street", 3, 40)
    best = best_of(pair, learnt(TAUGHT))
    assert best is not None
    wrong = best._replace(pose=pair.poses[0])
    rows = tenths([(best, 4.0), (best, 5.0), (wrong, -4.0), (wrong, 4.5)])
    assert [row["poses"] for row in rows] == [1, 3]
    assert rows[-1]["right"] == np.average([1, 1, 0])


@pytest.mark.long
def test_poses_that_lead_by_much_are_described_with_those_they_lead_over() -> None:
    """In a tunnel other poses fit nearly as well; those that the registration may drop show how far a pose leads."""
    config = Config()
    task = next(iter(tasks("tunnel", "32", 0.03, count=1, seed=9, config=config)))
    pair = described(task, config)
    right, others = pair.poses[0], pair.poses[1:]
    assert right.is_right
    leads = [
        paired_lead(shipped().ratios, [(right.of_source, other.of_source), (right.of_target, other.of_target)])
        for other in others
    ]
    assert min(leads) < NO_OTHER
