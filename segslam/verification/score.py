"""The probability that a pose between two scans is right, and what it is made of.

A pose is a chance fit unless the patches of the scans (`patches`) show enough of what right poses show more often than
the wrong poses that resemble them most, and few of them are where the other scan saw through. The log odds of a pose
that fits are a sum: its least lead over the other poses that were tried, the share of its patches in free space, and
the number of its patches. Patches beside each other err together, so the same lead counts less if there are many.
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

NO_OTHER = 10.0
"""Lead of a pose (standard deviations) if no other pose was found, and at most."""
LEAST_SCATTER = 1.0
"""Least standard deviation of the sum over all patches (nats), of poses that show the same."""


MISLED = 0.002
"""Share of the poses that are right or wrong for a reason that no patch shows, such as a place that looks the same.
Chosen: without it one pose at a wrong height decides all weights."""
MOST_LOG_ODDS = math.log((1.0 - MISLED) / MISLED)
"""Log odds of a pose of which scans alone cannot make more certain."""


class Judged(NamedTuple):
    """How probable a pose is."""

    log_odds: float
    """That it is right, in nats; right and wrong poses being equally frequent."""
    evidence: dict[str, float]
    """Its summands by name: what the patches show, what is `usual` for so many of them, the best `other_pose`, and what
    makes it a `chance_fit`."""

    @property
    def probability(self) -> float:
        """That the pose is right, 0 to 1."""
        return 1.0 / (1.0 + math.exp(-min(max(self.log_odds, -500.0), 500.0)))


class Weights(NamedTuple):
    """What the log odds of a pose that fits are made of."""

    free_space: float
    """Of the root of the share of patches in free space, against the pose."""
    number: float
    """Of the root of the number of patches, against the pose."""
    lead: float
    """Of the least lead over another pose."""
    offset: float


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """What was learnt from pairs whose poses are known."""

    ratios: Vector
    """log of how much more often right poses show a patch of each of `BINS` than wrong ones (nats)."""
    least_ratio: float
    """Mean log ratio of a patch that a pose has at least unless it is a chance fit (nats)."""
    most_free: float
    """Root of the share of patches in free space that it has at most."""
    chance: float
    """Log odds of a chance fit."""
    weights: Weights
    margin: float = 0.0
    """How much more the odds of all accepted poses together are than those of the least probable of them (nats)."""

    def least_odds(self, config: VerifyConfig) -> float:
        """Log odds that an accepted pose has at least, for a share of false ones of `max_false_share` in all."""
        return math.log((1.0 - config.max_false_share) / config.max_false_share) - self.margin

    def mean_ratio(self, counts: Counts) -> float:
        """Mean log ratio of a patch (nats); 0 without patches."""
        return float(counts @ self.ratios / max(counts.sum(), 1.0))

    def fits(self, counts: Counts) -> bool:
        """False for a chance fit, which no other evidence can make probable."""
        return self.mean_ratio(counts) >= self.least_ratio and violating_root(counts) <= self.most_free

    def log_odds(self, counts: Counts, lead: float) -> float:
        """Log odds of a pose by its patches, and by its least lead over another pose."""
        return self._fit_odds(counts, lead) if self.fits(counts) else self.chance

    def _fit_odds(self, counts: Counts, lead: float) -> float:
        weights = self.weights
        return (
            -weights.free_space * violating_root(counts)
            - weights.number * math.sqrt(counts.sum())
            + weights.lead * min(lead, NO_OTHER)
            + weights.offset
        )

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
        """A pose by its patches alone, whatever other poses show, which can only lower its odds."""
        return self._judged(counts, NO_OTHER)

    def judge(self, found: Agreement, others: Sequence[Agreement] | None = None) -> Judged:
        """A pose that shows `found`, where other poses that were tried show `others`.

        None for a pose that is known beforehand, so that no others were tried: it is judged by its patches alone.
        """
        if others is None:
            return self.judge_patches(found.counts)
        lead = min((self.lead_of(found, other) for other in others), default=NO_OTHER)
        judged = self._judged(found.counts, lead)
        of_lead = self.weights.lead * (min(lead, NO_OTHER) - NO_OTHER)
        judged.evidence["usual"] -= of_lead
        return judged._replace(evidence=judged.evidence | {"other_pose": of_lead})

    def _judged(self, counts: Counts, lead: float) -> Judged:
        evidence = {"free_space": -self.weights.free_space * violating_root(counts)}
        evidence["usual"] = self._fit_odds(counts, lead) - evidence["free_space"]
        if not self.fits(counts):
            evidence["chance_fit"] = self.chance - sum(evidence.values())
        return Judged(self.log_odds(counts, lead), evidence)

    def most_lead(self, counts: Counts, least_odds: float) -> float:
        """Lead over another pose beyond which it cannot lower the odds of a pose that fits below `least_odds`."""
        return (least_odds + RIVAL_NATS - self._fit_odds(counts, 0.0)) / self.weights.lead


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
    """A table from JSON: `ratios` by the name of the bin, and numbers by theirs. Raises KeyError for a missing one."""
    ratios: Any = content["ratios"]
    numbers: list[Any] = [content[name] for name in ("least_ratio", "most_free", "chance", *Weights._fields, "margin")]
    least_ratio, most_free, chance, *weights, margin = map(float, numbers)
    return Table(np.array([ratios[name] for name in BINS]), least_ratio, most_free, chance, Weights(*weights), margin)
