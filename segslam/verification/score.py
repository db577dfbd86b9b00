"""The probability that a pose between two scans is right, and what it is made of.

A pose can be wrong in two ways: as a chance fit of two places, or because another pose explains the scans as well. The
first is judged by the patches of the scans (`patches`): how much more often do right poses show them than the wrong
poses that resemble them most? The second by the lead over the best other pose that was tried. The likelier way counts.
`tools.benchmarks.score` measures all numbers in `score.json` on pairs of scans whose poses are known.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from segslam.core.config import VerifyConfig
from segslam.core.types import Vector
from segslam.verification.patches import BINS, Agreement, Counts, Shown

NO_OTHER = 12.0
"""Lead of a pose (standard deviations) if no other pose was found, and at most."""
LEAST_SCATTER = 1.0
"""Least standard deviation of the sum over all patches (nats), of poses that show the same."""
PARTS = {"surfaces": slice(2, None), "no_surface": slice(1, 2), "free_space": slice(0, 1)}


class Judged(NamedTuple):
    """How probable a pose is."""

    log_odds: float
    """That it is right, in nats; right and wrong poses being equally frequent."""
    evidence: dict[str, float]
    """Its summands by name: what the patches show, the `usual` value of all patches, and the best `other_pose`."""

    @property
    def probability(self) -> float:
        """That the pose is right, 0 to 1."""
        return 1.0 / (1.0 + math.exp(-min(max(self.log_odds, -500.0), 500.0)))


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """What was learnt from pairs whose poses are known."""

    ratios: Vector
    """log of how much more often right poses show a patch of each of `BINS` than wrong ones (nats)."""
    match: tuple[float, float]
    """Slope and offset of the log odds that a pose is no chance fit, by its mean ratio."""
    lead: tuple[float, float]
    """The same that no other pose is as good, by the least lead over another pose."""

    def mean_ratio(self, counts: Counts) -> float:
        """Mean log ratio of a patch (nats); 0 without patches."""
        return float(counts @ self.ratios / max(counts.sum(), 1.0))

    def match_odds(self, counts: Counts) -> float:
        """Log odds that a pose is no chance fit; another pose can only lower them."""
        return self.match[0] * self.mean_ratio(counts) + self.match[1]

    def lead_of(self, found: Agreement, other: Agreement) -> float:
        """How much more likely the patches are at one pose than at another, in standard deviations of the difference.

        Patches of which nothing is known at either pose do not count; nor do those of the target if the other pose
        has none.
        """
        pairs = [(found.of_source, other.of_source)]
        if len(other.of_target):
            pairs.append((found.of_target, other.of_target))
        return paired_lead(self.ratios, pairs)

    def judge(self, found: Agreement, others: Sequence[Agreement] | None = None) -> Judged:
        """A pose that shows `found`, where other poses that were tried show `others`.

        None for a pose that is known beforehand, so that no others were tried: it is judged by its patches alone.
        """
        counts = found.counts
        match = self.match_odds(counts)
        log_odds = match
        if others is not None:
            lead = min((self.lead_of(found, other) for other in others), default=NO_OTHER)
            log_odds = -float(np.logaddexp(-match, -(self.lead[0] * min(lead, NO_OTHER) + self.lead[1])))
        share = self.match[0] * counts * self.ratios / max(counts.sum(), 1.0)
        evidence = {name: float(share[bins].sum()) for name, bins in PARTS.items()} | {"usual": self.match[1]}
        return Judged(log_odds, evidence if others is None else evidence | {"other_pose": log_odds - match})

    def most_lead(self, least_odds: float) -> float:
        """Lead over another pose beyond which it cannot lower the odds of a pose below `least_odds`."""
        return (least_odds + RIVAL_NATS - self.lead[1]) / self.lead[0]


def paired_lead(ratios: Vector, pairs: Sequence[tuple[Shown, Shown]]) -> float:
    """Sum of the differences of the log ratios of the same patches, in standard deviations of this sum."""
    differences = [
        ratios[here[both]] - ratios[there[both]] for here, there in pairs for both in [(here >= 0) & (there >= 0)]
    ]
    each = np.concatenate(differences)
    return float(each.sum() / math.sqrt(float(each @ each) + LEAST_SCATTER**2))


RIVAL_NATS = 3.0
"""Poses that another makes so much likelier to be right than is asked are not compared with it."""


def least_odds(config: VerifyConfig) -> float:
    """Log odds that an accepted pose has at least."""
    return math.log((1.0 - config.max_false_share) / config.max_false_share)


@cache
def shipped() -> Table:
    """The table of this version."""
    text = files("segslam.verification").joinpath("score.json").read_text(encoding="utf-8")
    return table_of(json.loads(text))


def table_of(content: dict[str, object]) -> Table:
    """A table from JSON: `ratios` by the name of the bin, `match` and `lead`. Raises KeyError for a missing bin."""
    ratios, match, lead = content["ratios"], content["match"], content["lead"]
    assert isinstance(ratios, dict)
    assert isinstance(match, list)
    assert isinstance(lead, list)
    return Table(np.array([ratios[name] for name in BINS]), (match[0], match[1]), (lead[0], lead[1]))
