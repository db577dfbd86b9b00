"""The table of `segslam.verification.score`, learnt from pairs whose poses are known.

A pair counts as much as all others of its part together allow: each part weighs the same, and so do right and wrong
poses, so the prior odds are even.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from segslam.core.types import Transform, Vector
from segslam.registration import refinement
from segslam.verification.patches import BINS, FREE_SPACE, KINDS, Counts, Shown, counted
from segslam.verification.score import MISLED, NO_OTHER, Table, Weights, paired_lead, violating_root

PRIOR_COUNT = 0.5
"""Jeffreys': pseudo-counts of a bin or case that was never seen."""
PART_WEIGHT = 100.0
"""Number of poses as which a part counts in the ratios."""
FITS, LEADS = 3, [3, 2]
"""Of `ingredients`."""
TAIL = 20
"""Number of wrong poses that show how fast their odds fall."""
HOPELESS = -2.0
"""Log odds below which the calibration is not looked at: no such pose is ever accepted."""


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A pose that was tried, and what the scans show there."""

    T_target_source: Transform
    of_source: Shown
    of_target: Shown
    is_right: bool
    is_allowed: bool
    """By the prior."""

    @property
    def counts(self) -> Counts:
        """Patches of both scans in each bin."""
        return counted(self.of_source) + counted(self.of_target)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two scans, and the poses that were tried."""

    part: str
    sensor: str
    is_true: bool
    """True if the scans show the same place."""
    overlap: float
    """At the true pose; 0 for scans of different places."""
    poses: Sequence[Pose]
    verdict: str
    """Of the package with its own table: right, wrong, or the reason of the rejection."""
    seconds: float
    """CPU of the registration."""
    is_searched: bool = True
    """False if no other poses were searched, because the best one was improbable already."""


class Best(NamedTuple):
    """The best pose of a pair that the prior allows."""

    pair: Pair
    pose: Pose
    ratio: float
    lead: float
    """Standard deviations."""


def log_ratios(pairs: Sequence[Pair]) -> Vector:
    """log p1 / p0 of each bin: p1 of right poses, p0 of the wrong pose of each pair that resembles them most.

    A pose counts once, however many patches it has. What resembles right poses is judged by the ratios themselves.
    """
    ratios = np.zeros(len(BINS))
    ratios[FREE_SPACE :: len(KINDS)] = -1.0
    weight = {part: PART_WEIGHT / number for part, number in Counter(pair.part for pair in pairs).items()}
    for _ in range(3):
        right, wrong = np.full(len(BINS), PRIOR_COUNT), np.full(len(BINS), PRIOR_COUNT)
        for pair in pairs:
            for pose in pair.poses:
                right += weight[pair.part] * pose.is_right * _shares(pose.counts)
            others = [_shares(pose.counts) for pose in pair.poses if not pose.is_right]
            if others:
                wrong += weight[pair.part] * max(others, key=lambda shares: float(shares @ ratios))
        ratios = np.log(right / right.sum()) - np.log(wrong / wrong.sum())
    return ratios


def _shares(counts: Counts) -> Counts:
    return counts / max(counts.sum(), 1.0)


def best_of(pair: Pair, table: Table) -> Best | None:
    """The best pose, and its lead over those that differ; None if no others were searched, or the prior allows none."""
    ratios = [table.mean_ratio(pose.counts) for pose in pair.poses]
    allowed = [number for number, pose in enumerate(pair.poses) if pose.is_allowed]
    if not allowed or not pair.is_searched:
        return None
    first = max(allowed, key=ratios.__getitem__)
    best = pair.poses[first]
    leads = [
        paired_lead(table.ratios, [(best.of_source, pose.of_source), (best.of_target, pose.of_target)])
        for pose in pair.poses
        if not refinement.is_near(pose.T_target_source, [best.T_target_source])
    ]
    return Best(pair, best, ratios[first], min([*leads, NO_OTHER]))


def bests(pairs: Sequence[Pair], table: Table) -> list[tuple[Best, float]]:
    """Those of all pairs that have one, with their log odds."""
    found = (best_of(pair, table) for pair in pairs)
    return [(best, odds_of(best, table)) for best in found if best is not None]


def learnt(pairs: Sequence[Pair]) -> Table:
    """The table that these pairs teach. Its odds are too certain for other parts: `calibrated`.

    The weights are the most probable ones of a product of two logistic functions, in which right and wrong poses weigh
    the same.
    """
    blank = Table(log_ratios(pairs), Weights._make([0.0] * len(Weights._fields)))
    found = [best for pair in pairs if (best := best_of(pair, blank)) is not None]
    is_right = np.array([best.pose.is_right for best in found])
    values = np.array([ingredients(best) for best in found])
    mean, scale = values.mean(axis=0), values.std(axis=0) + 1e-9
    weight, standard = _weights(found), (values - mean) / scale

    def loss(numbers: Vector) -> float:
        fit = standard[:, :FITS] @ numbers[:FITS] + numbers[FITS]
        unique = standard[:, LEADS] @ numbers[-3:-1] + numbers[-1]
        odds = -np.logaddexp(-fit, np.logaddexp(-unique, -fit - unique))
        return _surprise(odds, is_right, weight) + 0.5 * float((numbers**2).sum())

    numbers = minimize(loss, np.ones(FITS + len(LEADS) + 2)).x
    fit, unique = numbers[:FITS] / scale[:FITS], numbers[-3:-1] / scale[LEADS]
    offset, lead_offset = numbers[FITS] - fit @ mean[:FITS], numbers[-1] - unique @ mean[LEADS]
    weights = np.array([*fit, offset, *unique, lead_offset, 1.0, 0.0])
    return replace(blank, weights=Weights._make(weights.tolist()))


def _weights(found: Sequence[Best]) -> Vector:
    """(n,) of best poses: right and wrong ones weigh the same, and so do the right ones of each part."""
    number = Counter(best.pair.part for best in found if best.pose.is_right)
    num_right, num_wrong = number.total(), len(found) - number.total()
    each = num_right / max(len(number), 1)
    return np.array(
        [each / number[one.pair.part] if one.pose.is_right else num_right / max(num_wrong, 1) for one in found]
    )


def _surprise(odds: Vector, is_right: np.ndarray, weight: Vector) -> float:
    """Negative log-likelihood of what is right, given log odds; `MISLED` of the poses follow no odds."""
    likelihood = MISLED + (1.0 - 2.0 * MISLED) * expit(np.where(is_right, odds, -odds))
    return -float(weight @ np.log(likelihood))


def ingredients(best: Best) -> Vector:
    """(4,) of a best pose: what tells whether it fits by chance (`FITS`), or another fits as well (`LEADS`)."""
    counts = best.pose.counts
    return np.array([best.ratio, -violating_root(counts), -np.sqrt(counts.sum()), best.lead])


def left_out(pairs: Sequence[Pair]) -> list[tuple[Best, float]]:
    """Best poses and their log odds by what all other parts teach."""
    found: list[tuple[Best, float]] = []
    for own, others in by_part(pairs, pairs):
        found += bests(own, learnt(others))
    return found


def by_part(pairs: Sequence[Pair], taught: Sequence[Pair]) -> Iterator[tuple[list[Pair], list[Pair]]]:
    """The pairs of each part, and those of all other parts in `taught`."""
    for part in sorted({pair.part for pair in pairs}):
        yield [pair for pair in pairs if pair.part == part], [pair for pair in taught if pair.part != part]


def odds_of(best: Best, table: Table) -> float:
    """Log odds of a best pose."""
    return table.log_odds(best.pose.counts, best.lead)


def calibration(pairs: Sequence[Pair], scored: Sequence[tuple[Best, float]]) -> tuple[float, float]:
    """Slope and offset by which log odds of parts that taught nothing become those observed, at even prior odds.

    True and false pairs weigh the same, also those without a pose; poses of hopeless odds are left out.
    """
    number = Counter(pair.is_true for pair in pairs)
    kept = [(best.pose.is_right, odds) for best, odds in scored if odds > HOPELESS]
    is_right, odds = np.array([right for right, _ in kept]), np.array([value for _, value in kept])
    weight = np.where(is_right, 1.0, number[True] / max(number[False], 1))

    def loss(line: Vector) -> float:
        prior = 0.5 * float((((line - [1.0, 0.0]) / 4.0) ** 2).sum())
        return _surprise(line[0] * odds + line[1], is_right, weight) + prior

    slope, offset = minimize(loss, np.array([1.0, 0.0])).x
    return float(slope), float(offset)


def margin(pairs: Sequence[Pair], scored: Sequence[tuple[Best, float]], share: float) -> float:
    """How far below the log odds of this share of false poses the least odds may be, of which all above have it.

    The odds of wrong poses beyond the `TAIL` best of them are taken to fall exponentially.
    """
    number = Counter(pair.is_true for pair in pairs)
    wrong = np.sort([odds for best, odds in scored if not best.pose.is_right])[::-1]
    right = np.array([odds for best, odds in scored if best.pose.is_right])
    start, scale = wrong[TAIL], float(np.median(wrong[:TAIL] - wrong[TAIL])) / np.log(2.0)
    accepted = float(np.mean(right > start)) * len(right) / number[True]
    least = start + scale * np.log(TAIL / number[False] / (share * accepted))
    return float(np.log((1.0 - share) / share) - least)


def calibrated(table: Table, line: tuple[float, float]) -> Table:
    """A table whose log odds are those of `table` moved to this line."""
    return replace(table, weights=table.weights._replace(slope=line[0], shift=line[1]))
