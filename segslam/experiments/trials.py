"""A trial: two scans, each possibly rotated or with labels removed, and their true relative pose."""

import math
from dataclasses import dataclass

import numpy as np

from segslam import geometry
from segslam.types import Label, Labels, Points, Transform


@dataclass(frozen=True, slots=True)
class ScanVariant:
    """A scan by its number, and what is done to it before any method sees it."""

    index: int
    yaw_deg: float = 0.0
    """Turned by so much about z."""
    lost: float = 0.0
    """Share of the points, 0 to 1, whose labels are taken away."""
    draw: int = 0
    """Which of the random choices of those points."""

    @property
    def T_variant_scan(self) -> Transform:  # noqa: N802  (a transform)
        """The turn."""
        return geometry.transform(geometry.yaw(math.radians(self.yaw_deg)), 0.0)

    def turned(self, points: Points) -> Points:
        """The points of the scan in the frame of this variant."""
        return geometry.apply(self.T_variant_scan, points).astype(points.dtype) if self.yaw_deg else points

    def remaining(self, labels: Labels) -> Labels:
        """The labels of the scan without those that are taken away."""
        if not self.lost:
            return labels
        lost = np.random.default_rng([self.draw, self.index]).random(len(labels)) < self.lost
        return np.where(lost, np.uint8(Label.UNLABELLED), labels)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One pair that each method registers. `T_target_source` is the truth, of the variants."""

    pairs: str
    """Name of the list that the pair is of."""
    source: ScanVariant
    target: ScanVariant
    T_target_source: Transform

    @property
    def key(self) -> tuple[str, ScanVariant, ScanVariant]:
        """Identifies the trial."""
        return self.pairs, self.source, self.target


def trial(pairs: str, source: ScanVariant, target: ScanVariant, T_target_source: Transform) -> Trial:
    """The trial of two variants, given the true pose of the scans as they are."""
    T_true = target.T_variant_scan @ T_target_source @ geometry.inverse(source.T_variant_scan)
    return Trial(pairs, source, target, T_true)
