"""The probability that a pose between two scans is right, and what it is made of.

A pose is wrong if it fits by chance, or if another fits as well. The log odds against a chance fit are a sum of how
much more often right poses show what the patches of the scans show (`patches`) than the wrong poses that resemble them
most, of the share of the patches where the other scan saw through, and of their number. The log odds against another
pose are a sum of the least lead over the poses that were tried, and of the number of patches: patches beside each other
err together, so the same lead counts less if there are many. `tools.benchmarks.score` measures all numbers in
`score.json` on pairs of scans whose poses are known.
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
from segslam.verification.patches import BINS, FREE_SPACE, KINDS, Agreement, Counts, Shown

NO_OTHER = 10.0
"""Lead of a pose (standard deviations) if no other pose was found, and at most."""
LEAST_SCATTER = 1.0
"""Least standard deviation of the sum over all patches (nats), of poses that show the same."""


MISLED = 0.002
"""Share of the poses that are right or wrong for a reason that no patch shows, such as a place that looks the same.
Chosen: without it one pose at a wrong height decides all weights."""


class Judged(NamedTuple):
    """How probable a pose is."""

    log_odds: float
    """That it is right, in nats; right and wrong poses being equally frequent."""
    evidence: dict[str, float]
    """Its summands by name: the `surfaces` that patches lie on, `free_space`, what is `usual` for so many patches, and
    by how much the best `other_pose` lowers the sum of these."""

    @property
    def probability(self) -> float:
        """That the pose is right, 0 to 1."""
        return 1.0 / (1.0 + math.exp(-min(max(self.log_odds, -500.0), 500.0)))


class Weights(NamedTuple):
    """What the log odds that a pose does not fit by chance, and that no other fits as well, are made of."""

    ratio: float
    """Of the mean log ratio of a patch."""
    free_space: float
    """Of the root of the share of patches in free space, against the pose."""
    number: float
    """Of the root of the number of patches, against the pose."""
    offset: float
    lead: float
    """Of the least lead over another pose."""
    lead_number: float
    """Of the root of the number of patches, against the lead."""
    lead_offset: float
    slope: float = 1.0
    """Of the odds of places that taught nothing, against the odds that these numbers give."""
    shift: float = 0.0
    """Added to the odds after that (nats)."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """What was learnt from pairs whose poses are known."""

    ratios: Vector
    """log of how much more often right poses show a patch of each of `BINS` than wrong ones (nats)."""
    weights: Weights
    margin: float = 0.0
    """How much more the odds of all accepted poses together are than those of the least probable of them (nats)."""

    def least_odds(self, config: VerifyConfig) -> float:
        """Log odds that an accepted pose has at least, for a share of false ones of `max_false_share` in all."""
        return log_odds_of_all(config) - self.margin

    @property
    def most_log_odds(self) -> float:
        """Log odds that no pose exceeds: as unique as poses without any other are, in scans of few patches."""
        weights = self.weights
        return weights.shift + weights.slope * (weights.lead * NO_OTHER + weights.lead_offset)

    def mean_ratio(self, counts: Counts) -> float:
        """Mean log ratio of a patch (nats); 0 without patches."""
        return float(counts @ self.ratios / max(counts.sum(), 1.0))

    def log_odds(self, counts: Counts, lead: float = NO_OTHER) -> float:
        """Log odds of a pose by its patches, and by its least lead over another pose, which can only lower them."""
        weights = self.weights
        fit = (sum(self._fit(counts).values()) - weights.shift) / weights.slope
        unique = self._unique(counts, lead)
        # log odds of p q, for the probabilities p, q that neither way to be wrong is the case
        return weights.shift - weights.slope * float(np.logaddexp.reduce([-fit, -unique, -fit - unique]))

    def lead_of(self, found: Agreement, other: Agreement) -> float:
        """How much more likely the patches are at one pose than at another, in standard deviations of the difference.

        Patches that are out of view at either pose do not count; nor do those of the target if the other pose has none.
        """
        pairs = [(found.of_source, other.of_source)]
        if len(other.of_target):
            pairs.append((found.of_target, other.of_target))
        return paired_lead(self.ratios, pairs)

    def judge_patches(self, counts: Counts) -> Judged:
        """A pose by its patches alone, whatever other poses show, which can only lower its odds."""
        evidence = self._fit(counts)
        return Judged(sum(evidence.values()), evidence)

    def judge(self, found: Agreement, others: Sequence[Agreement] | None = None) -> Judged:
        """A pose that shows `found`, where other poses that were tried show `others`.

        None for a pose that is known beforehand, so that no others were tried: it is judged by its patches alone.
        """
        alone = self.judge_patches(found.counts)
        if others is None:
            return alone
        lead = min((self.lead_of(found, other) for other in others), default=NO_OTHER)
        odds = self.log_odds(found.counts, lead)
        return Judged(odds, alone.evidence | {"other_pose": odds - alone.log_odds})

    def _fit(self, counts: Counts) -> dict[str, float]:
        """Summands of the log odds of a pose that no other can rival."""
        weights = self.weights
        usual = weights.offset - weights.number * math.sqrt(counts.sum())
        return {
            "surfaces": weights.slope * weights.ratio * self.mean_ratio(counts),
            "free_space": -weights.slope * weights.free_space * violating_root(counts),
            "usual": weights.slope * usual + weights.shift,
        }

    def _unique(self, counts: Counts, lead: float) -> float:
        """Log odds that no other pose fits as well, before `slope` and `shift`."""
        weights = self.weights
        return weights.lead * min(lead, NO_OTHER) - weights.lead_number * math.sqrt(counts.sum()) + weights.lead_offset

    def most_lead(self, counts: Counts, least_odds: float) -> float:
        """Lead over another pose beyond which it cannot lower the odds of a pose below `least_odds`."""
        weights = self.weights
        least_unique = (least_odds + RIVAL_NATS - weights.shift) / weights.slope
        return (least_unique - self._unique(counts, 0.0)) / weights.lead


def log_odds_of_all(config: VerifyConfig) -> float:
    """Log odds that accepted poses have together, for a share of false ones of `max_false_share`."""
    return math.log((1.0 - config.max_false_share) / config.max_false_share)


def paired_lead(ratios: Vector, pairs: Sequence[tuple[Shown, Shown]]) -> float:
    """Sum of the differences of the log ratios of the same patches, in standard deviations of this sum."""
    differences = [
        ratios[here[both]] - ratios[there[both]] for here, there in pairs for both in [(here >= 0) & (there >= 0)]
    ]
    each = np.concatenate(differences)
    return float(each.sum() / math.sqrt(float(each @ each) + LEAST_SCATTER**2))


def violating_root(counts: Counts) -> float:
    """Root of the share of the patches that are in free space; two more of four count, for scans with few patches."""
    return math.sqrt((counts[FREE_SPACE :: len(KINDS)].sum() + 2.0) / (counts.sum() + 4.0))


RIVAL_NATS = 3.0
"""Other poses are not looked for if the lead alone gives odds this far above the least odds of an accepted pose."""


@cache
def shipped() -> Table:
    """The table of this version."""
    text = files("segslam.verification").joinpath("score.json").read_text(encoding="utf-8")
    return table_of(json.loads(text))


def table_of(content: dict[str, object]) -> Table:
    """A table from JSON: `ratios` by the name of the bin, and numbers by theirs. Raises KeyError for a missing one."""
    ratios: Any = content["ratios"]
    numbers: list[Any] = [content[name] for name in (*Weights._fields, "margin")]
    *weights, margin = map(float, numbers)
    return Table(np.array([ratios[name] for name in BINS]), Weights(*weights), margin)
