"""The table of `segslam.verification.score`, learnt from pairs whose poses are known.

A pair counts as much as all others of its part together allow: each part weighs the same, and so do right and wrong
poses, so the prior odds are even.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from segslam.core.types import Transform, Vector
from segslam.verification.patches import BINS, Counts, Shown, counted
from segslam.verification.rivals import SAME_POSE_M, SAME_POSE_RAD
from segslam.verification.score import MISLED, NO_OTHER, Table, Weights, paired_lead, violating_root
from segslam.verification.trial import is_near

PRIOR_COUNT = 0.5
"""Jeffreys': pseudo-counts of a bin or case that was never seen."""
PART_WEIGHT = 100.0
"""Number of poses as which a part counts in the ratios."""
LOST = 0.03, 0.02
"""Chosen: shares of right poses that are given up as chance fits for their mean ratio, and for free space."""
HUNDREDTHS = np.linspace(0.0, 1.0, 101)
SIGMA = 3.0
"""Normal prior of the weights, in standard deviations of what they multiply."""
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
    """False if no other poses were searched, because the best one was a chance fit by the table of the package."""


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
    ratios[0] = -1.0
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
    """The best pose, and its lead over those that differ; None for a chance fit, or if the prior allows no pose."""
    ratios = [table.mean_ratio(pose.counts) for pose in pair.poses]
    allowed = [number for number, pose in enumerate(pair.poses) if pose.is_allowed]
    if not allowed or not pair.is_searched:
        return None
    first = max(allowed, key=ratios.__getitem__)
    best = pair.poses[first]
    if not table.fits(best.counts):
        return None
    leads = [
        paired_lead(table.ratios, [(best.of_source, pose.of_source), (best.of_target, pose.of_target)])
        for pose in pair.poses
        if not is_near(pose.T_target_source, [best.T_target_source], within_m=SAME_POSE_M, within_rad=SAME_POSE_RAD)
    ]
    return Best(pair, best, ratios[first], min([*leads, NO_OTHER]))


def bests(pairs: Sequence[Pair], table: Table) -> list[Best]:
    """Those of all pairs that have one."""
    return [best for pair in pairs for best in [best_of(pair, table)] if best is not None]


def learnt(pairs: Sequence[Pair]) -> Table:
    """The table that these pairs teach. Its odds are too certain for other parts: `calibrated`.

    The weights are those of a logistic regression in which right and wrong poses weigh the same.
    """
    ratios = log_ratios(pairs)
    limits = _limits(pairs, ratios)
    blank = Table(ratios, *limits, _chance(pairs, ratios, *limits), Weights(0.0, 0.0, 0.0, 0.0))
    found = bests(pairs, blank)
    is_right = np.array([best.pose.is_right for best in found])
    values = np.array([ingredients(best) for best in found])
    mean, scale = values.mean(axis=0), values.std(axis=0) + 1e-9
    weight = _weights(found)

    def loss(numbers: Vector) -> float:
        odds = (values - mean) / scale @ numbers[:-1] + numbers[-1]
        return _surprise(odds, is_right, weight) + 0.5 * float(((numbers[:-1] / SIGMA) ** 2).sum())

    numbers = minimize(loss, np.array([1.0, 1.0, 1.0, 0.0])).x
    weights = numbers[:-1] / scale
    return replace(blank, weights=Weights._make([*weights.tolist(), float(numbers[-1] - weights @ mean)]))


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
    """(3,) of a best pose, in the order of `Weights`."""
    counts = best.pose.counts
    return np.array([-violating_root(counts), -np.sqrt(counts.sum()), best.lead])


def _limits(pairs: Sequence[Pair], ratios: Vector) -> tuple[float, float]:
    """Least mean ratio and largest root of the share in free space: all but `LOST` of the right poses keep them.

    Each part weighs the same.
    """
    right: defaultdict[str, list[Counts]] = defaultdict(list)
    for pair in pairs:
        right[pair.part] += [pose.counts for pose in pair.poses if pose.is_right]
    ratio = [np.quantile([_shares(counts) @ ratios for counts in part], HUNDREDTHS) for part in right.values()]
    free = [np.quantile([violating_root(counts) for counts in part], HUNDREDTHS) for part in right.values()]
    return float(np.quantile(ratio, LOST[0])), float(np.quantile(free, 1.0 - LOST[1]))


def _chance(pairs: Sequence[Pair], ratios: Vector, least_ratio: float, most_free: float) -> float:
    """Log odds of a pose beyond the limits, right and wrong poses being equally frequent."""
    beyond: dict[bool, list[bool]] = {True: [], False: []}
    for pose in (pose for pair in pairs for pose in pair.poses):
        fits = _shares(pose.counts) @ ratios >= least_ratio and violating_root(pose.counts) <= most_free
        beyond[pose.is_right].append(not fits)
    shares = {is_right: (sum(rows) + PRIOR_COUNT) / (len(rows) + 1.0) for is_right, rows in beyond.items()}
    return float(np.log(shares[True] / shares[False]))


def left_out(pairs: Sequence[Pair]) -> list[tuple[Best, float]]:
    """Best poses and their log odds by what all other parts teach."""
    found: list[tuple[Best, float]] = []
    for part in sorted({pair.part for pair in pairs}):
        table = learnt([pair for pair in pairs if pair.part != part])
        found += [(best, odds_of(best, table)) for best in bests([pair for pair in pairs if pair.part == part], table)]
    return found


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

    The odds of wrong poses beyond the `TAIL` best of them are taken to fall exponentially; because few of them show
    how fast, a third of the share is aimed at.
    """
    number = Counter(pair.is_true for pair in pairs)
    wrong = np.sort([odds for best, odds in scored if not best.pose.is_right])[::-1]
    right = np.array([odds for best, odds in scored if best.pose.is_right])
    start, scale = wrong[TAIL], float(np.median(wrong[:TAIL] - wrong[TAIL])) / np.log(2.0)
    accepted = float(np.mean(right > start)) * len(right) / number[True]
    least = start + scale * np.log(TAIL / number[False] / (share / 3.0 * accepted))
    return float(np.log((1.0 - share) / share) - least)


def calibrated(table: Table, line: tuple[float, float]) -> Table:
    """A table whose log odds are those of `table` moved to this line."""
    *weights, offset = (line[0] * weight for weight in table.weights)
    return replace(table, weights=Weights._make([*weights, offset + line[1]]))
