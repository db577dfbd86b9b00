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
from segslam.verification.score import NO_OTHER, Table, paired_lead
from segslam.verification.trial import is_near

PRIOR_COUNT = 0.5
"""Jeffreys': pseudo-counts of a bin that was never seen."""
PART_WEIGHT, CLASS_WEIGHT = 100.0, 60.0
"""Number of poses as which a part counts in the ratios, and either class of a part in the slopes."""
START = np.array([0.7, 0.7, 2.0, 2.0])
SIGMA = np.array([1.5, 1.5, 3.0, 3.0])
"""Normal prior of the logarithms of two slopes, in standard deviations of what they multiply, and of two offsets."""


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
    """The best pose, and its lead over those that differ from it; None if the prior allows none."""
    ratios = [table.mean_ratio(pose.counts) for pose in pair.poses]
    allowed = [number for number, pose in enumerate(pair.poses) if pose.is_allowed]
    if not allowed:
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
    blank = Table(log_ratios(pairs), (1.0, 0.0), (1.0, 0.0))
    found = bests(pairs, blank)
    values = np.array([[best.ratio, best.lead] for best in found])
    mean, scale = values.mean(axis=0), values.std(axis=0) + 1e-9
    is_right, weight = _weighed(found)

    def loss(numbers: Vector) -> float:
        odds = _odds((values - mean) / scale * np.exp(numbers[:2]) + numbers[2:])
        prior = 0.5 * (((numbers - START) / SIGMA) ** 2).sum()
        return float((weight * np.logaddexp(0.0, np.where(is_right, -odds, odds))).sum() + prior)

    numbers = minimize(loss, START).x
    slopes = np.exp(numbers[:2]) / scale
    offsets = numbers[2:] - slopes * mean
    return Table(blank.ratios, (slopes[0], offsets[0]), (slopes[1], offsets[1]))


def left_out(pairs: Sequence[Pair]) -> list[tuple[Best, float]]:
    """Best poses and their log odds by what all other parts teach."""
    found: list[tuple[Best, float]] = []
    for part in sorted({pair.part for pair in pairs}):
        table = learnt([pair for pair in pairs if pair.part != part])
        found += [(best, odds_of(best, table)) for best in bests([pair for pair in pairs if pair.part == part], table)]
    return found


def odds_of(best: Best, table: Table) -> float:
    """Log odds of a best pose."""
    both = np.array([[table.match[0] * best.ratio + table.match[1], table.lead[0] * best.lead + table.lead[1]]])
    return float(_odds(both)[0])


def calibration(scored: Sequence[tuple[Best, float]]) -> tuple[float, float]:
    """Slope and offset by which log odds of parts that taught nothing become those observed."""
    odds = np.array([value for _, value in scored])
    is_right, weight = _weighed([best for best, _ in scored])

    def loss(line: Vector) -> float:
        line_odds = line[0] * odds + line[1]
        prior = 0.5 * (((line - [1.0, 0.0]) / 2.0) ** 2).sum()
        return float((weight * np.logaddexp(0.0, np.where(is_right, -line_odds, line_odds))).sum() + prior)

    slope, offset = minimize(loss, np.array([1.0, 0.0])).x
    return float(slope), float(offset)


def calibrated(table: Table, line: tuple[float, float]) -> Table:
    """A table whose log odds are those of `table` moved to this line."""
    (match, also), (lead, more) = table.match, table.lead
    return Table(table.ratios, (line[0] * match, line[0] * also + line[1]), (line[0] * lead, line[0] * more + line[1]))


def _weighed(found: Sequence[Best]) -> tuple[np.ndarray, Vector]:
    """Right or not, and the weight, of each best pose."""
    groups = [(best.pair.part, best.pose.is_right) for best in found]
    number = Counter(groups)
    return np.array([right for _, right in groups]), np.array([CLASS_WEIGHT / number[group] for group in groups])


def _odds(both: np.ndarray) -> Vector:
    """(n,) of the two ways to be wrong, the likelier one counts; `both` (n, 2)."""
    found: Vector = -np.logaddexp(-both[:, 0], -both[:, 1])
    return found
