"""Trials: two scans, each possibly rotated or with labels removed, and their true relative pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from segslam.bench.experiments.pairs import PairList, true_poses
from segslam.core import geometry
from segslam.core.types import Label, Labels, Points, Trajectory, Transform

PAPER_PAIR = PairList("0 and 10", np.array([[0, 10]]), 1)
"""The scans of 05 with which the paper tests rotation and removal of labels."""


@dataclass(frozen=True, slots=True)
class ScanVariant:
    """A scan, and the changes applied to it before registration."""

    index: int
    yaw_deg: float = 0.0
    """Rotation about z."""
    lost: float = 0.0
    """Share of the points, 0 to 1, whose labels are removed."""
    draw: int = 0
    """Number of the random draw of those points."""

    @property
    def T_variant_scan(self) -> Transform:  # noqa: N802  (a transform)
        """The rotation as a transform."""
        return geometry.transform(geometry.yaw(math.radians(self.yaw_deg)), 0.0)

    def turned(self, points: Points) -> Points:
        """The points of the scan in the frame of this variant."""
        return geometry.apply(self.T_variant_scan, points).astype(points.dtype) if self.yaw_deg else points

    def remaining(self, labels: Labels) -> Labels:
        """The labels of the scan, with the removed ones set to UNLABELLED."""
        if not self.lost:
            return labels
        lost = np.random.default_rng([self.draw, self.index]).random(len(labels)) < self.lost
        return np.where(lost, np.uint8(Label.UNLABELLED), labels)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A pair of variants to register; `T_target_source` is the true pose between the variants."""

    pairs: str
    """Name of the list that contains the pair."""
    source: ScanVariant
    target: ScanVariant
    T_target_source: Transform

    @property
    def key(self) -> tuple[str, ScanVariant, ScanVariant]:
        """Identifies the trial."""
        return self.pairs, self.source, self.target


def trial(pairs: str, source: ScanVariant, target: ScanVariant, T_target_source: Transform) -> Trial:
    """The trial of two variants, from the true pose of the unchanged scans."""
    T_true = target.T_variant_scan @ T_target_source @ geometry.inverse(source.T_variant_scan)
    return Trial(pairs, source, target, T_true)


def pair_trials(
    pairs: PairList,
    reference: Trajectory | None,
    *,
    step_deg: float = 360.0,
    lost_percent: Sequence[float] = (0.0,),
    num_draws: int = 1,
    seed: int = 0,
    both: bool = False,
) -> list[Trial]:
    """The trials of each pair; by default one, of the unchanged scans.

    The source is rotated about z in steps of `step_deg`. Each of the shares `lost_percent` of its labels is removed
    `num_draws` times at random, with `both` also from the target. Raises SegslamError for a pair without known true
    pose.
    """
    return [
        trial(
            pairs.name,
            ScanVariant(source, float(yaw_deg), percent / 100, draw),
            ScanVariant(target, lost=percent / 100, draw=draw) if both else ScanVariant(target),
            T_target_source,
        )
        for (source, target), T_target_source in true_poses(pairs, reference).items()
        for yaw_deg in np.arange(0.0, 360.0, step_deg)
        for percent in lost_percent
        for draw in range(seed * num_draws, (seed + 1) * num_draws)
    ]
