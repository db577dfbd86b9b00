"""An edge of the graph as numbers, and as a factor of GTSAM."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from jaxtyping import Float

from segslam.core.types import Information, Transform, Vector

Kernel = Any
"""One of gtsam.noiseModel.mEstimator; their common base is not in GTSAM's stubs."""
Transforms = Float[np.ndarray, "_ 4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """The measured pose of vertex b in vertex a."""

    a: int
    b: int
    T_a_b: Transform
    information: Information

    def factor(self, *, weight: float = 1.0, kernel: Kernel | None = None) -> gtsam.BetweenFactorPose3:
        """The between-factor with its information times `weight`, under `kernel` if there is one."""
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Information(weight * self.information)
        if kernel is not None:
            model = gtsam.noiseModel.Robust.Create(kernel, model)
        return gtsam.BetweenFactorPose3(self.a, self.b, gtsam.Pose3(self.T_a_b), model)


def factor_graph(edges: Iterable[Edge], *, kernel: Kernel | None = None) -> gtsam.NonlinearFactorGraph:
    """The between-factors of some edges."""
    graph = gtsam.NonlinearFactorGraph()
    for edge in edges:
        graph.add(edge.factor(kernel=kernel))
    return graph


def joined(*graphs: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    """One graph with the factors of all, in this order."""
    whole = gtsam.NonlinearFactorGraph()
    for graph in graphs:
        whole.push_back(graph)
    return whole


def squared_errors(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Vector:
    """Squared whitened error (chi-square, twice GTSAM's error) of each factor; none may have a robust kernel."""
    return np.array([2.0 * graph.at(i).error(values) for i in range(graph.size())])


def values_of(T_world: Transforms) -> gtsam.Values:
    """Poses under the keys 0, 1, 2, ..."""
    values = gtsam.Values()
    for key, T_world_key in enumerate(T_world):
        values.insert(key, gtsam.Pose3(T_world_key))
    return values


def poses_by_id(values: gtsam.Values) -> Transforms:
    """All poses, sorted by key."""
    rows = np.asarray(gtsam.utilities.extractPose3(values)).reshape(-1, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses
