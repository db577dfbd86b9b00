"""The table of `segslam.verification.score`, learnt from pairs whose poses are known.

A pair counts as much as all others of its part together allow: each part weighs the same, and so do right and wrong
poses, so the prior odds are even.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from segslam.core.types import Transform, Vector
from segslam.verification.patches import BINS, Counts, Shown, counted
from segslam.verification.rivals import SAME_POSE_M, SAME_POSE_RAD
from segslam.verification.score import NO_OTHER, Table, paired_lead, violating_root
from segslam.verification.trial import is_near

PRIOR_COUNT = 0.5
"""Jeffreys': pseudo-counts of a bin that was never seen."""
PART_WEIGHT, CLASS_WEIGHT = 100.0, 60.0
"""Number of poses as which a part counts in the ratios, and either class of a part in the slopes."""
START = np.array([0.7, 0.7, 0.7, 2.0, 2.0, 2.0])
SIGMA = np.array([2.0, 2.0, 2.0, 6.0, 6.0, 6.0])
"""Normal prior of the logarithms of the slopes, in standard deviations of what they multiply, and of the offsets."""
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
    """False if no other poses were searched, because the best one was hopeless by the table of the package."""


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
    """The best pose, and its lead over those that differ from it; None if it is hopeless or the prior allows none."""
    ratios = [table.mean_ratio(pose.counts) for pose in pair.poses]
    allowed = [number for number, pose in enumerate(pair.poses) if pose.is_allowed]
    if not allowed or not pair.is_searched:
        return None
    first = max(allowed, key=ratios.__getitem__)
    best = pair.poses[first]
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
    """The table that these pairs teach. Its odds are too certain for other parts: `calibrated`."""
    ratios = log_ratios(pairs)
    blank = Table(ratios, (1.0, 0.0), (1.0, 0.0), (1.0, 0.0))
    found = bests(pairs, blank)
    values = np.array([ingredients(best) for best in found])
    mean, scale = values.mean(axis=0), values.std(axis=0) + 1e-9
    is_right, weight = _weighed(found)

    def loss(numbers: Vector) -> float:
        odds = _odds((values - mean) / scale * np.exp(numbers[:3]) + numbers[3:])
        prior = 0.5 * (((numbers - START) / SIGMA) ** 2).sum()
        return float((weight * np.logaddexp(0.0, np.where(is_right, -odds, odds))).sum() + prior)

    numbers = minimize(loss, START).x
    slopes = np.exp(numbers[:3]) / scale
    offsets = numbers[3:] - slopes * mean
    match, free, lead = ((float(slope), float(offset)) for slope, offset in zip(slopes, offsets, strict=True))
    return Table(ratios, match, free, lead)


def ingredients(best: Best) -> Vector:
    """(3,) of a best pose: mean ratio, freedom from violations, and squared lead."""
    return np.array([best.ratio, -violating_root(best.pose.counts), best.lead * abs(best.lead)])


def left_out(pairs: Sequence[Pair]) -> list[tuple[Best, float]]:
    """Best poses and their log odds by what all other parts teach."""
    found: list[tuple[Best, float]] = []
    for part in sorted({pair.part for pair in pairs}):
        table = learnt([pair for pair in pairs if pair.part != part])
        found += [(best, odds_of(best, table)) for best in bests([pair for pair in pairs if pair.part == part], table)]
    return found


def odds_of(best: Best, table: Table) -> float:
    """Log odds of a best pose."""
    slopes, offsets = np.array(_lines(table)).T
    return float(_odds((slopes * ingredients(best) + offsets)[None])[0])


def calibration(pairs: Sequence[Pair], scored: Sequence[tuple[Best, float]]) -> tuple[float, float]:
    """Slope and offset by which log odds of parts that taught nothing become those observed, at even prior odds.

    True and false pairs weigh the same, also those without a pose; poses of hopeless odds are left out.
    """
    number = Counter(pair.is_true for pair in pairs)
    kept = [(best.pose.is_right, odds) for best, odds in scored if odds > HOPELESS]
    is_right, odds = np.array([right for right, _ in kept]), np.array([value for _, value in kept])
    weight = np.where(is_right, 1.0, number[True] / max(number[False], 1))

    def loss(line: Vector) -> float:
        line_odds = line[0] * odds + line[1]
        prior = 0.5 * (((line - [1.0, 0.0]) / 4.0) ** 2).sum()
        return float((weight * np.logaddexp(0.0, np.where(is_right, -line_odds, line_odds))).sum() + prior)

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
    start, scale = wrong[TAIL], float(np.mean(wrong[:TAIL] - wrong[TAIL]))
    accepted = float(np.mean(right > start)) * len(right) / number[True]
    least = start + scale * np.log(TAIL / number[False] / (share / 3.0 * accepted))
    return float(np.log((1.0 - share) / share) - least)


def calibrated(table: Table, line: tuple[float, float]) -> Table:
    """A table whose log odds are those of `table` moved to this line."""
    match, free, lead = ((line[0] * slope, line[0] * offset + line[1]) for slope, offset in _lines(table))
    return Table(table.ratios, match, free, lead)


def _lines(table: Table) -> tuple[tuple[float, float], ...]:
    return table.match, table.free, table.lead


def _weighed(found: Sequence[Best]) -> tuple[np.ndarray, Vector]:
    """Right or not, and the weight, of each best pose."""
    groups = [(best.pair.part, best.pose.is_right) for best in found]
    number = Counter(groups)
    return np.array([right for _, right in groups]), np.array([CLASS_WEIGHT / number[group] for group in groups])


def _odds(ways: np.ndarray) -> Vector:
    """(n,) of the ways to be wrong, the likeliest one counts; `ways` (n, 3)."""
    found: Vector = -np.logaddexp.reduce(-ways, axis=1)
    return found
