"""The ratio of likelihoods of right and wrong poses, learnt from pairs whose poses are known.

A pose is right if it is no chance fit of two places, and if no other pose that was tried explains the scans as well.
The first is judged against the run itself: its neighbours, whose poses are known, and its impossible pairs, each at its
best pose. In a corridor both look similar, and the demand rises by itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from segslam.core.types import Transform, Vector
from segslam.verification.rivals import SAME_POSE_M, SAME_POSE_RAD
from segslam.verification.trial import is_near
from tools.benchmarks.score.evidence import BINS, Counts

PRIOR_COUNT = 0.5
"""Jeffreys': pseudo-counts of a bin that was never seen."""
NUM_LEARNT = 3.0
"""Chosen: number of pairs of a run that count as much as what other runs taught."""
START = np.array([np.log(30.0), 0.0, np.log(10.0), np.log(10.0), 0.0])
START_SIGMA = 2.0
"""Chosen: normal prior of the parameters of a `Score`, wide: the slopes within factors of 7."""


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A pose that was tried, and what the scans show there."""

    T_target_source: Transform
    counts: Counts
    is_right: bool


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Scans of one sensor in one world, and what its neighbours show at their known poses."""

    part: str
    sensor: str
    neighbours: list[Counts] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two scans, the poses that were tried, and what the gates said."""

    run: Run
    is_true: bool
    """True if the scans show the same place."""
    poses: Sequence[Pose]
    verdict: str
    """Of the gates: right, wrong, or the reason of the rejection."""
    seconds: float
    """CPU of the registration with the gates."""


class Scored(NamedTuple):
    """The best pose of a pair, and the ingredients of its score (nats a patch)."""

    best: Pose
    lead: float
    """Mean log ratio of its patches over that of the best other pose; infinite if no other was tried."""
    above_impossible: float
    """Over that of the impossible pairs of the run."""
    above_neighbours: float
    """Over that of the neighbours of the run; mostly negative."""
    num_patches: float

    @property
    def ingredients(self) -> Vector:
        return np.array(self[1:])


def log_ratios(pairs: Sequence[Pair]) -> Counts:
    """log p1 / p0 of each bin: p1 of right poses, p0 of the wrong pose of each pair that resembles them most.

    A pose counts once, however many patches it has. What resembles right poses is judged by the ratios themselves.
    """
    ratios = np.zeros((2, len(BINS)))
    ratios[:, 0] = -1.0
    for _ in range(3):
        right, wrong = np.full(ratios.shape, PRIOR_COUNT), np.full(ratios.shape, PRIOR_COUNT)
        for pair in pairs:
            for pose in pair.poses:
                right += pose.is_right * _shares(pose.counts)
            others = [pose.counts for pose in pair.poses if not pose.is_right]
            if others:
                wrong += _shares(others[int(np.argmax([mean_ratio(counts, ratios) for counts in others]))])
        ratios = np.log(right / right.sum(axis=1, keepdims=True)) - np.log(wrong / wrong.sum(axis=1, keepdims=True))
    return ratios


def _shares(counts: Counts) -> Counts:
    return counts / max(counts.sum(), 1.0)


def mean_ratio(counts: Counts, ratios: Counts) -> float:
    """Mean log ratio of a patch (nats), whatever the other poses show."""
    return float((_shares(counts) * ratios).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """log odds that the best pose of a pair is right: of the two ways to be wrong, the likelier one counts."""

    ratios: Counts
    impossible: float
    neighbours: float
    """Mean ratio of best poses of impossible pairs, and of right poses: for runs that have measured none."""
    num_patches: float = 1.0
    """Of the median pose."""
    slopes: Vector = field(default_factory=lambda: START)

    @classmethod
    def learnt(cls, pairs: Sequence[Pair]) -> "Score":
        """From pairs with poses. Right and wrong best poses weigh the same, so the prior odds are even."""
        ratios = log_ratios(pairs)
        blank = cls(ratios, _mean(_impossible(pairs, ratios), 0.0), _mean(_right(pairs, ratios), 0.0))
        scored = [blank.scored(pair, pairs) for pair in pairs if pair.poses]
        ingredients = np.array([one.ingredients for one in scored])
        typical = float(np.median(ingredients[:, -1]))
        is_right = np.array([one.best.is_right for one in scored])
        slopes = _fitted(ingredients, is_right, typical)
        return cls(ratios, blank.impossible, blank.neighbours, typical, slopes)

    def scored(self, pair: Pair, others: Sequence[Pair]) -> Scored:
        """A pair with poses; `others`: pairs of which those of the same run show what impossible ones look like."""
        ratios = np.array([mean_ratio(pose.counts, self.ratios) for pose in pair.poses])
        best = pair.poses[int(ratios.argmax())]
        rivals = [
            ratio
            for ratio, pose in zip(ratios, pair.poses, strict=True)
            if not is_near(pose.T_target_source, [best.T_target_source], within_m=SAME_POSE_M, within_rad=SAME_POSE_RAD)
        ]
        own = [other for other in others if other.run is pair.run and other is not pair]
        impossible = _shrunk(_impossible(own, self.ratios), self.impossible)
        known = [mean_ratio(counts, self.ratios) for counts in pair.run.neighbours]
        most = float(ratios.max())
        lead = most - max(rivals, default=-np.inf)
        return Scored(best, lead, most - impossible, most - _shrunk(known, self.neighbours), best.counts.sum() / 2.0)

    def log_odds(self, scored: Scored) -> float:
        """At even prior odds."""
        return float(_log_odds(self.slopes, scored.ingredients[None], self.num_patches)[0])


def _impossible(pairs: Sequence[Pair], ratios: Counts) -> list[float]:
    return [max(mean_ratio(pose.counts, ratios) for pose in p.poses) for p in pairs if p.poses and not p.is_true]


def _right(pairs: Sequence[Pair], ratios: Counts) -> list[float]:
    return [mean_ratio(pose.counts, ratios) for pair in pairs for pose in pair.poses if pose.is_right]


def _mean(values: Sequence[float], otherwise: float) -> float:
    return float(np.mean(values)) if values else otherwise


def _shrunk(own: Sequence[float], learnt: float) -> float:
    """Mean of the run's own values, with what other runs taught as `NUM_LEARNT` further ones."""
    return (sum(own) + NUM_LEARNT * learnt) / (len(own) + NUM_LEARNT)


def _log_odds(slopes: Vector, ingredients: np.ndarray, typical: float) -> Vector:
    """(n,) that a pose is right, neither ambiguous nor a chance fit.

    The scatter of a mean ratio falls with the root of the number of patches, so the lead counts in its unit.
    """
    lead, above_impossible, above_neighbours, num_patches = ingredients.T
    ambiguous = slopes[1] - np.exp(slopes[0]) * lead * np.sqrt(num_patches / typical)
    chance = slopes[4] - np.exp(slopes[2]) * above_impossible - np.exp(slopes[3]) * above_neighbours
    return -np.logaddexp(ambiguous, chance)


def _fitted(ingredients: np.ndarray, is_right: np.ndarray, typical: float) -> Vector:
    """Maximum a posteriori slopes; both classes weigh the same."""
    share = np.where(is_right, is_right.mean(), 1.0 - is_right.mean())
    importance = 0.5 / np.maximum(share, 1.0 / len(is_right))

    def loss(slopes: Vector) -> float:
        odds = _log_odds(slopes, ingredients, typical)
        losses = importance * np.logaddexp(0.0, np.where(is_right, -odds, odds))
        return float(losses.sum() + 0.5 * (((slopes - START) / START_SIGMA) ** 2).sum())

    found: Vector = minimize(loss, START).x
    return found
