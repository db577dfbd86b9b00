"""Poses of a scan in a local map: proposed in several ways, registered, and ordered by their probability.

The likelihood of the points prefers poses at which a scan of new surroundings overlaps the map most: it slides back
along a wall. So different poses are compared by the score of loops, to which points out of the map's sight say nothing.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from segslam.core import geometry
from segslam.core.types import Alignment, Information, Points, Rejected, Transform
from segslam.keyframes import DENSE_VOXELS
from segslam.odometry.likelihood import Fit
from segslam.odometry.local_map import LocalMap, SeenScan
from segslam.odometry.nudge import NUM_POINTS
from segslam.verification import patches, score

Recover = Callable[[Points, Points], Alignment | Rejected]
"""Registers a source (n, 3) with a target (m, 3) without initial guess, and verifies the result."""
Prior = Callable[[Fit], float]
"""Log of the probability of the motion to a pose."""
TURNS_RAD = np.radians([-45.0, -30.0, -15.0, 15.0, 30.0, 45.0])
TRAVELS = (0.0, 0.5, 1.0, 1.5)
"""Chosen: turns about each axis, and shares of the predicted motion, from which a scan is registered that no proposal
explains. Registration reaches half as far."""
TURNS = (np.zeros(6), *(turn * axis for axis in np.eye(6)[:3] for turn in TURNS_RAD))
"""The same as tangents, with no turn: a sensor that is carried, or a robot on two wheels, turns about any axis."""
NUM_REGISTERED = 3
"""Chosen: number of the most probable of these that are registered with all points."""


class PoseSearch:
    """The search for the pose of one scan in a local map."""

    def __init__(self, local: LocalMap, scan: SeenScan, *, prior: Prior = lambda fit: 0.0) -> None:
        """By default, any motion is as probable."""
        self.local, self._scan, self._prior = local, scan, prior

    def is_same(self, T_map_a: Transform, T_map_b: Transform) -> bool:
        """True if a registration from one of two poses reaches the other."""
        return geometry.displacement_m(self._scan.moments, T_map_a, T_map_b) < self.local.same_m

    def near(self, T_map_proposed: Sequence[Transform], known: Sequence[Fit] = ()) -> list[Fit]:
        """`known` poses and those to which registrations from the proposals lead, the most probable first."""
        starts: list[Transform] = []
        for T_map_start in T_map_proposed:
            if not any(self.is_same(T_map_start, T_map_other) for T_map_other in starts):
                starts.append(T_map_start)
        return self._compared([*known, *self._registered(starts)])

    def beside(self, T_map_proposed: Sequence[Transform]) -> list[Fit]:
        """The pose beside the first proposal at which a few steps from each one end; none if one ends elsewhere."""
        first = T_map_proposed[0]
        starts = [first, *(T for T in T_map_proposed[1:] if not self.is_same(T, first))]
        found = [self.local.approach(self._scan, T_map_start, num_points=NUM_POINTS) for T_map_start in starts]
        fits = [fit for fit in found if fit is not None and self.is_same(fit.T_map_lidar, first)]
        return [self._with_prior(fits[0])] if len(fits) == len(starts) else []

    def around(self, T_map_last: Transform, T_step: Transform, known: Sequence[Fit]) -> list[Fit]:
        """`known` poses and those reached from poses around the last one: turned, and moved by shares of `T_step`."""
        starts = [
            T_map_last @ geometry.transform(geometry.exp(turn)[:3, :3], travel * T_step[:3, 3])
            for travel in TRAVELS
            for turn in TURNS
        ]
        reached = [self.local.approach(self._scan, T_map_start) for T_map_start in starts]
        found = [*known, *(self._with_prior(fit) for fit in reached if fit is not None)]
        found = self._compared(found, num_ordered=NUM_REGISTERED + len(known))
        others = [fit.T_map_lidar for fit in found if all(fit.T_map_lidar is not one.T_map_lidar for one in known)]
        return self._compared([*found, *self._registered(others[:NUM_REGISTERED])])

    def without_guess(self, recover: Recover) -> list[Fit]:
        """Poses reached from the one that place recognition finds and verifies; none if it finds none.

        `recover` receives the newest scans of the map, as many as have `DENSE_VOXELS`.
        """
        alignment = recover(self._scan.points, self.local.cloud(DENSE_VOXELS))
        if isinstance(alignment, Rejected):
            return []
        return self.local.register(self._scan, alignment.fine.T_target_source)

    def elsewhere(self, fits: Sequence[Fit]) -> float:
        """Probability that a pose far from the most probable one is right instead; 1 without any pose."""
        if not fits:
            return 1.0
        far = [fit for fit in fits[1:] if self._apart_m(fits[0], fit) > self.local.reach_m]
        return max((as_likely(fit, fits[0]) for fit in far), default=0.0)

    def log_odds(self, fit: Fit) -> float:
        """Log odds that a pose is right, by the score of loops (nats)."""
        if fit.log_odds is not None:
            return fit.log_odds
        return score.shipped().log_odds(patches.counts_at(self._scan.observed, self.local.observed, fit.T_map_lidar))

    def log_ratio(self, fit: Fit, other: Fit) -> float:
        """How much more probable the scan makes a pose than another, whatever the last motions were (nats)."""
        one, another = (self.log_odds(each) + each.log_likelihood for each in (fit, other))
        return one - another

    def spread(self, fits: Sequence[Fit]) -> Information:
        """Covariance (6, 6) of the choice between poses near the most probable one, tangent in the scan's frame."""
        covariance, total = np.zeros((6, 6)), 1.0
        for fit in fits[1:]:
            if self._apart_m(fits[0], fit) <= self.local.reach_m:
                offset = geometry.log(geometry.inverse(fits[0].T_map_lidar) @ fit.T_map_lidar)
                weight = as_likely(fit, fits[0])
                covariance += weight * np.outer(offset, offset)
                total += weight
        return covariance / total

    def _registered(self, starts: Iterable[Transform]) -> list[Fit]:
        return [self._with_prior(fit) for T_map in starts for fit in self.local.register(self._scan, T_map)]

    def _with_prior(self, fit: Fit) -> Fit:
        return replace(fit, log_prior=self._prior(fit))

    def _apart_m(self, one: Fit, other: Fit) -> float:
        return geometry.displacement_m(self._scan.moments, one.T_map_lidar, other.T_map_lidar)

    def _compared(self, fits: Sequence[Fit], *, num_ordered: int = 1) -> list[Fit]:
        """The most probable pose first; of poses near each other only the one that explains the scan best.

        So many poses are in order; the others follow, of which those that cannot be among these are not scored.
        """
        kept: list[Fit] = []
        for fit in sorted(fits, key=lambda each: -_log_without_score(each)):
            if not any(self.is_same(fit.T_map_lidar, other.T_map_lidar) for other in kept):
                kept.append(fit)
        if len(kept) < 2:
            return kept
        judged: list[Fit] = []
        for fit in kept:
            last = judged[num_ordered - 1] if len(judged) >= num_ordered else None
            if last and _log_posterior(last) > _log_without_score(fit) + score.shipped().most_log_odds:
                break  # no score brings this pose or a later one before it
            judged.append(replace(fit, log_odds=self.log_odds(fit)))
            judged.sort(key=lambda each: -_log_posterior(each))
        return [*judged, *kept[len(judged) :]]


def as_likely(fit: Fit, best: Fit) -> float:
    """How likely the points and the motion make a pose, compared with the best one; at most 1.

    The score, which orders poses, makes some wrong ones too sure: after eleven gaps in NCLT and KITTI 00 the best of
    wrong poses led by 1 to 29 nats with it.
    """
    return math.exp(min(0.0, _log_without_score(fit) - _log_without_score(best)))


def _log_posterior(fit: Fit) -> float:
    assert fit.log_odds is not None
    return fit.log_odds + _log_without_score(fit)


def _log_without_score(fit: Fit) -> float:
    return fit.log_likelihood + fit.log_prior
