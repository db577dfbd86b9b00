"""The probability of a pose: calibrated on stored pairs, and lowered by other poses that fit as well."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from segslam.core.config import VerifyConfig, load_config
from segslam.core.types import Alignment, Registration, Rejected, RejectReason
from segslam.verification.patches import BINS, Agreement
from segslam.verification.score import NO_OTHER, RIVAL_NATS, Table, Weights, shipped, table_of
from segslam.verification.trial import Found, judged

STORED = Path(__file__).with_name("judged_pairs.npz")
"""Best poses of pairs of scenes and real drives: patches in each bin, lead over other poses, right or not."""
CONFIG = load_config()
MOST_WRONG = 3 / 625
NUMBERS = (*Weights._fields, "margin")
GOOD, BAD = BINS.index("far, residual 0"), BINS.index("far, free space")


def _wrong_and_lost(table: Table) -> tuple[float, float]:
    """Shares of the stored wrong poses that are accepted, and of the right ones that are not."""
    with np.load(STORED) as stored:
        counts, lead, is_right = stored["counts"].astype(float), stored["lead"], stored["is_right"]
    odds = np.array([table.log_odds(row, value) for row, value in zip(counts, lead.tolist(), strict=True)])
    is_accepted = odds >= table.least_odds(CONFIG.verify)
    return float(is_accepted[~is_right].mean()), float(1.0 - is_accepted[is_right].mean())


def test_no_pose_exceeds_the_most_log_odds() -> None:
    rng = np.random.default_rng(0)
    table = shipped()
    seen = [
        np.bincount(rng.choice(len(BINS), 200, p=rng.dirichlet(np.full(len(BINS), 0.05))), minlength=len(BINS))
        for _ in range(500)
    ]
    odds = [table.log_odds(counts.astype(float) * size / 200) for counts in seen for size in (1, 50, 300, 2000)]
    assert table.most_log_odds - 6.0 < max(odds) < table.most_log_odds


def test_on_stored_pairs_hardly_a_wrong_pose_is_accepted_and_few_right_ones_are_lost() -> None:
    """625 wrong poses, each the best of a pair: three are accepted, two of them of scans of one place."""
    wrong, lost = _wrong_and_lost(shipped())
    assert wrong <= MOST_WRONG
    assert lost < 0.05


@pytest.mark.parametrize("change", ["bins exchanged", "signs exchanged", "no lead", "too certain", "free space good"])
def test_a_wrong_table_fails_on_the_stored_pairs(change: str) -> None:
    table = shipped()
    wrong_table = {
        "bins exchanged": replace(table, ratios=table.ratios[::-1]),
        "signs exchanged": replace(table, ratios=-table.ratios),
        "no lead": replace(table, weights=table.weights._replace(lead=0.0)),
        "too certain": replace(table, weights=table.weights._replace(offset=table.weights.offset + 5.0)),
        "free space good": replace(table, weights=table.weights._replace(free_space=-table.weights.free_space)),
    }[change]
    wrong, lost = _wrong_and_lost(wrong_table)
    assert wrong > 3.0 * MOST_WRONG or lost > 0.3


def _agreement(good: int, bad: int, known: int = 200) -> Agreement:
    """Of a source with so many patches that match a surface, and that are in free space; the others are unknown."""
    shown = np.full(known, -1, np.int8)
    shown[:good], shown[good : good + bad] = GOOD, BAD
    return Agreement(0.5, 0.1, 0.0, shown, shown)


def test_a_pose_that_fits_is_probable_unless_another_fits_as_well() -> None:
    table = shipped()
    found, poor = _agreement(190, 5), _agreement(60, 120)
    assert table.judge(found, [poor]).probability > 0.999
    assert table.judge(poor, []).probability < 0.05
    ambiguous = table.judge(found, [poor, found])
    assert ambiguous.probability < 0.5
    assert ambiguous.evidence["other_pose"] < -5.0


def test_the_evidence_adds_up_to_the_log_odds() -> None:
    for others in (None, [], [_agreement(150, 20)]):
        judgement = shipped().judge(_agreement(170, 10), others)
        assert sum(judgement.evidence.values()) == pytest.approx(judgement.log_odds)
        assert judgement.probability == pytest.approx(1.0 / (1.0 + math.exp(-judgement.log_odds)))
        assert ("other_pose" in judgement.evidence) == (others is not None)
        assert judgement.evidence["usual"] > 0.0 > judgement.evidence["free_space"]
    poor = shipped().judge(_agreement(60, 120))
    assert poor.evidence["surfaces"] < 0.0
    assert poor.log_odds < shipped().judge(_agreement(170, 10)).log_odds - 10.0


def test_the_lead_counts_differences_of_the_same_patches_in_their_scatter() -> None:
    """Ten patches that differ prove as much among 20 as among 200; patches known at one pose only prove nothing."""
    table = shipped()
    leads = [table.lead_of(_agreement(n, 0, n), _agreement(n - 10, 10, n)) for n in (20, 200)]
    assert leads[0] == pytest.approx(leads[1])
    assert leads[0] == pytest.approx(-table.lead_of(_agreement(10, 10, 20), _agreement(20, 0, 20)))
    assert table.lead_of(_agreement(100, 0), _agreement(0, 0)) == 0.0
    counts = _agreement(198, 2).counts
    odds = [table.log_odds(counts, lead) for lead in (99.0, NO_OTHER, 0.0, -1.0)]
    assert odds[0] == odds[1] > odds[2] > odds[3]


def test_the_same_lead_counts_less_if_there_are_many_patches() -> None:
    odds = [shipped().log_odds(_agreement(99 * n, n, 100 * n).counts, 5.0) for n in (1, 4, 16)]
    assert odds[0] > odds[1] > odds[2]


def test_only_poses_that_can_lower_the_odds_below_the_least_are_looked_for() -> None:
    table, counts = shipped(), _agreement(198, 2).counts
    lead = table.most_lead(counts, 3.0)
    assert table.log_odds(counts, lead) == pytest.approx(3.0 + RIVAL_NATS, abs=0.01)


def test_the_patches_of_another_place_are_not_compared() -> None:
    elsewhere = _agreement(100, 50)._replace(of_target=np.empty(0, np.int8))
    alone = shipped().lead_of(_agreement(190, 0), elsewhere)
    assert 0.0 < alone < shipped().lead_of(_agreement(190, 0), _agreement(100, 50))


def test_the_share_of_false_loops_is_the_one_threshold() -> None:
    fine = Registration(np.eye(4), 9, 9, 0.1, np.eye(6))
    found = _agreement(198, 1)
    pose = Found(fine, fine, found)
    tried = ([_agreement(198 - more, 1 + more)] for more in range(30))
    others = next(other for other in tried if shipped().judge(found, other).probability > 0.9)
    probability = shipped().judge(found, others).probability
    assert 0.9 < probability < 0.99999
    odds, margin = shipped().judge(found, others).log_odds, shipped().margin
    for least, is_accepted in ((odds + margin - 0.1, True), (odds + margin + 0.1, False)):
        config = load_config(overrides=[f"verify.max_false_share={1.0 / (1.0 + math.exp(least))}"])
        outcome = judged(pose, [Found(fine, fine, other) for other in others], config=config)
        assert isinstance(outcome, Alignment) == is_accepted
        assert outcome.probability == pytest.approx(probability)
        if isinstance(outcome, Rejected):
            assert outcome.reason is RejectReason.AMBIGUOUS
            assert "other pose" in outcome.detail
    table = replace(shipped(), margin=1.0)
    assert table.least_odds(VerifyConfig(max_false_share=0.01)) == pytest.approx(math.log(99.0) - 1.0)


def test_a_table_without_a_bin_is_refused() -> None:
    with pytest.raises(KeyError, match="near, no surface"):
        table_of({"ratios": {"near, free space": -1.0}, **dict.fromkeys(NUMBERS, 0.0)})
