"""The probability that a pose between two scans is right, and what it is made of.

A pose can be wrong in three ways: as a chance fit of two places; because one scan stands where the other saw through;
or because another pose explains the scans as well. The first is judged by the patches of the scans (`patches`): how
much more often do right poses show them than the wrong poses that resemble them most? The second by the share of
patches in free space, the third by the lead over each other pose that was tried. The likeliest way counts.
`tools.benchmarks.score` measures all numbers in `score.json` on pairs of scans whose poses are known.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from segslam.core.config import VerifyConfig
from segslam.core.types import Vector
from segslam.verification.patches import BINS, Agreement, Counts, Shown

NO_OTHER = 7.0
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
    free: tuple[float, float]
    """The same that it does not contradict free space, by the root of the share of its patches that do."""
    lead: tuple[float, float]
    """The same that no other pose is as good, by the square of the least lead over another pose, with its sign."""
    margin: float = 0.0
    """How much more the odds of all accepted poses together are than those of the least probable of them (nats)."""

    def least_odds(self, config: VerifyConfig) -> float:
        """Log odds that an accepted pose has at least, for a share of false ones of `max_false_share` in all."""
        return math.log((1.0 - config.max_false_share) / config.max_false_share) - self.margin

    def mean_ratio(self, counts: Counts) -> float:
        """Mean log ratio of a patch (nats); 0 without patches."""
        return float(counts @ self.ratios / max(counts.sum(), 1.0))

    def match_odds(self, counts: Counts) -> float:
        """Log odds of a pose whatever other poses show, which can only lower them."""
        return -float(np.logaddexp(-self._fit_odds(counts), -self._free_odds(counts)))

    def _fit_odds(self, counts: Counts) -> float:
        return self.match[0] * self.mean_ratio(counts) + self.match[1]

    def _free_odds(self, counts: Counts) -> float:
        return self.free[1] - self.free[0] * violating_root(counts)

    def lead_odds(self, lead: float) -> float:
        """Log odds that no other pose is as good, by the least lead."""
        capped = min(lead, NO_OTHER)
        return self.lead[0] * capped * abs(capped) + self.lead[1]

    def lead_of(self, found: Agreement, other: Agreement) -> float:
        """How much more likely the patches are at one pose than at another, in standard deviations of the difference.

        Patches of which nothing is known at either pose do not count; nor do those of the target if the other pose
        has none.
        """
        pairs = [(found.of_source, other.of_source)]
        if len(other.of_target):
            pairs.append((found.of_target, other.of_target))
        return paired_lead(self.ratios, pairs)

    def judge_patches(self, counts: Counts) -> Judged:
        """A pose by its patches alone, whatever other poses show."""
        log_odds = self.match_odds(counts)
        share = self.match[0] * counts * self.ratios / max(counts.sum(), 1.0)
        evidence = {name: float(share[bins].sum()) for name, bins in PARTS.items()} | {"usual": self.match[1]}
        evidence["free_space"] += log_odds - self._fit_odds(counts)
        return Judged(log_odds, evidence)

    def judge(self, found: Agreement, others: Sequence[Agreement] | None = None) -> Judged:
        """A pose that shows `found`, where other poses that were tried show `others`.

        None for a pose that is known beforehand, so that no others were tried: it is judged by its patches alone.
        """
        alone = self.judge_patches(found.counts)
        if others is None:
            return alone
        lead = min((self.lead_of(found, other) for other in others), default=NO_OTHER)
        log_odds = -float(np.logaddexp(-alone.log_odds, -self.lead_odds(lead)))
        return Judged(log_odds, alone.evidence | {"other_pose": log_odds - alone.log_odds})

    def most_lead(self, least_odds: float) -> float:
        """Lead over another pose beyond which it cannot lower the odds of a pose below `least_odds`."""
        return math.sqrt(max(least_odds + RIVAL_NATS - self.lead[1], 0.0) / self.lead[0])


def paired_lead(ratios: Vector, pairs: Sequence[tuple[Shown, Shown]]) -> float:
    """Sum of the differences of the log ratios of the same patches, in standard deviations of this sum."""
    differences = [
        ratios[here[both]] - ratios[there[both]] for here, there in pairs for both in [(here >= 0) & (there >= 0)]
    ]
    each = np.concatenate(differences)
    return float(each.sum() / math.sqrt(float(each @ each) + LEAST_SCATTER**2))


def violating_root(counts: Counts) -> float:
    """Root of the share of the patches that are in free space; two more of four count, for scans with few patches."""
    return math.sqrt((counts[0] + 2.0) / (counts.sum() + 4.0))


RIVAL_NATS = 3.0
"""Other poses are not looked for if their lead odds are more than this above the least odds of an accepted pose."""


@cache
def shipped() -> Table:
    """The table of this version."""
    text = files("segslam.verification").joinpath("score.json").read_text(encoding="utf-8")
    return table_of(json.loads(text))


def table_of(content: dict[str, object]) -> Table:
    """A table from JSON: `ratios` by the name of the bin, and three lines. Raises KeyError for a missing bin."""
    ratios: Any = content["ratios"]
    lines: list[Any] = [content[name] for name in ("match", "free", "lead")]
    match, free, lead = ((float(slope), float(offset)) for slope, offset in lines)
    margin: Any = content["margin"]
    return Table(np.array([ratios[name] for name in BINS]), match, free, lead, float(margin))
