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

from segslam.config import VerifyConfig
from segslam.types import Vector
from segslam.verification.patches import BINS, Agreement, Counts

TYPICAL_PATCHES = 300.0
"""Number of patches in whose unit the scatter of a mean ratio counts; it falls with the root of the number."""
NO_OTHER = 1.0
"""Lead of a pose (nats a patch) if no other pose was found."""
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
    """The same that no other pose is as good, by the lead over the best other pose."""

    def mean_ratio(self, counts: Counts) -> float:
        """Mean log ratio of a patch (nats); 0 without patches."""
        return float(counts @ self.ratios / max(counts.sum(), 1.0))

    def match_odds(self, counts: Counts) -> float:
        """Log odds that a pose is no chance fit; another pose can only lower them."""
        return self.match[0] * self.mean_ratio(counts) + self.match[1]

    def lead_odds(self, lead: float, num_patches: float) -> float:
        """Log odds that no other pose is as good; `lead`: difference of two mean ratios."""
        return self.lead[0] * lead * math.sqrt(num_patches / TYPICAL_PATCHES) + self.lead[1]

    def judge(self, found: Agreement, others: Sequence[Agreement] | None = None) -> Judged:
        """A pose that shows `found`, where other poses that were tried show `others`.

        None for a pose that is known beforehand, so that no others were tried: it is judged by its patches alone.
        """
        match = self.match_odds(found.counts)
        log_odds = match
        if others is not None:
            best = max((self.mean_ratio(other.counts) for other in others), default=-math.inf)
            lead = min(self.mean_ratio(found.counts) - best, NO_OTHER)
            log_odds = -float(np.logaddexp(-match, -self.lead_odds(lead, found.num_patches)))
        share = self.match[0] * found.counts * self.ratios / max(found.counts.sum(), 1.0)
        evidence = {name: float(share[bins].sum()) for name, bins in PARTS.items()} | {"usual": self.match[1]}
        return Judged(log_odds, evidence if others is None else evidence | {"other_pose": log_odds - match})

    def least_ratio_of_rivals(self, found: Counts, least_odds: float) -> float:
        """Mean ratio that another pose needs at least to lower the odds of a pose below `least_odds` (nats)."""
        lead = (least_odds + RIVAL_NATS - self.lead[1]) / (
            self.lead[0] * math.sqrt(max(found.sum(), 1.0) / 2.0 / TYPICAL_PATCHES)
        )
        return self.mean_ratio(found) - lead


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
