"""A closure as the graph sees it: one between-factor that may be weighted or put under a robust kernel."""

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from segslam import geometry
from segslam.types import Information, Transform, Vector

Kernel = Any
"""One of gtsam.noiseModel.mEstimator; their common base is not in GTSAM's stubs."""


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """What ties a keyframe to an older one."""

    target_id: int
    source_id: int
    T_target_source: gtsam.Pose3
    information: Information

    def factor(self, *, weight: float = 1.0, kernel: Kernel | None = None) -> gtsam.BetweenFactorPose3:
        """The factor with its information times `weight`, under `kernel` if there is one."""
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Information(weight * self.information)
        if kernel is not None:
            model = gtsam.noiseModel.Robust.Create(kernel, model)
        return gtsam.BetweenFactorPose3(self.target_id, self.source_id, self.T_target_source, model)


def pose3(T_a_b: Transform) -> gtsam.Pose3:
    """The same as GTSAM's type, its rotation made exact: rounding would add up along a chain and stop the solver."""
    return gtsam.Pose3(gtsam.Rot3(geometry.nearest_rotation(T_a_b[:3, :3])), T_a_b[:3, 3])


def squared_errors(closures: list[Closure], values: gtsam.Values) -> Vector:
    """(k,) squared whitened error (chi-square, twice GTSAM's error) of each closure."""
    return np.array([2.0 * closure.factor().error(values) for closure in closures])
