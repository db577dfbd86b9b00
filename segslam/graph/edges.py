"""An edge of the graph as numbers, and as a factor of GTSAM; breaks.

Breaks are motions of the odometry that are almost unknown. They divide a drive into segments, which closures locate. An
optimisation that starts far from the solution may end in a local optimum, so each segment is first moved as a rigid
body to satisfy one closure.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, compress
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import csc_array

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Information, Mask, Transform, Vector

Kernel = Any
"""One of gtsam.noiseModel.mEstimator; their common base is not in GTSAM's stubs."""
BREAK_M, BREAK_DEG = 1.0, 5.0
"""A motion with a larger standard deviation is a break. Chosen: 100 m of healthy odometry have a tenth of it.
A drive whose heading is as unsure is not placed by position fixes."""


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


def kernel_weights(edges: Sequence[Edge], values: gtsam.Values, kernel: Kernel | None) -> list[float]:
    """(k,) weight of each edge at these poses under a robust kernel: 1 (full weight) to 0, and 1 without a kernel."""
    if kernel is None:
        return [1.0] * len(edges)
    return [kernel.weight(error) for error in np.sqrt(squared_errors(factor_graph(edges), values)).tolist()]


def jacobian(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[csc_array, Vector]:
    """(6 f, 6 k) whitened derivatives of f factors by the tangents of all poses, sorted by key; (6 f,) their errors."""
    rows, columns, entries = graph.linearize(values).sparseJacobian_()
    shape = 6 * graph.size(), 6 * values.size() + 1
    whole = csc_array((entries, (rows.astype(int) - 1, columns.astype(int) - 1)), shape=shape)
    return whole[:, :-1], whole[:, -1:].toarray()[:, 0]


def values_of(T_world: Iterable[Transform], keys: Iterable[int] | None = None) -> gtsam.Values:
    """Poses under their keys, by default 0, 1, 2, ..."""
    values = gtsam.Values()
    for key, T_world_key in enumerate(T_world) if keys is None else zip(keys, T_world, strict=True):
        values.insert(key, gtsam.Pose3(T_world_key))
    return values


def poses_by_id(values: gtsam.Values) -> Poses:
    """All poses, sorted by key."""
    rows = np.asarray(gtsam.utilities.extractPose3(values)).reshape(-1, 12)
    return geometry.transforms(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])


def chained(odometry: Sequence[Edge]) -> Poses:
    """(n, 4, 4) poses by the motions alone, from each vertex 0, 1, 2, ... to the next, in the frame of the first."""
    return np.array(list(accumulate((edge.T_a_b for edge in odometry), np.matmul, initial=np.eye(4))))


def rotated(odometry: Sequence[Edge], turns: Iterable[Vector]) -> list[Edge]:
    """The motions, each followed by a rotation: (n, 3) rotation vectors (rad)."""
    return [
        replace(edge, T_a_b=edge.T_a_b @ geometry.exp(geometry.tangent(rotation_rad=turn, translation_m=0.0)))
        for edge, turn in zip(odometry, turns, strict=True)
    ]


def is_break(edge: Edge) -> bool:
    """True if the standard deviation of a motion is above that of a break in any direction."""
    rotation, translation = largest_variances(edge.information)
    return rotation > math.radians(BREAK_DEG) ** 2 or translation > BREAK_M**2


def largest_variances(information: Information) -> tuple[float, float]:
    """Variances of rotation (rad^2) and translation (m^2), each in its least certain direction."""
    known, directions = np.linalg.eigh(information)
    covariance = directions / np.maximum(known, np.finfo(float).eps) @ directions.T
    rotation, translation = (np.linalg.eigvalsh(covariance[half, half])[-1] for half in (slice(0, 3), slice(3, 6)))
    return float(rotation), float(translation)


def relinked(odometry: Sequence[Edge], closures: Sequence[Edge], T_world: Poses, likely: Mask) -> Poses:
    """(n, 4, 4) poses in which `likely` closures (k,) join the segments of a drive.

    Segments that already fit the closure that joins them are not moved; segments without one follow the segment before.
    """
    segment = np.cumsum([False, *(is_break(edge) for edge in odometry)])  # of each keyframe, from 0
    joining = [edge for edge in compress(closures, likely) if segment[edge.a] != segment[edge.b]]
    if not joining:
        return T_world
    moved = T_world.copy()
    placed = {0}
    while len(placed) <= segment[-1]:
        step = next((edge for edge in joining if (segment[edge.a] in placed) != (segment[edge.b] in placed)), None)
        if step is None:
            first = min({*range(segment[-1] + 1)} - placed)
            row = int(np.argmax(segment == first))
            step = Edge(row - 1, row, geometry.inverse(T_world[row - 1]) @ T_world[row], odometry[row - 1].information)
        if segment[step.a] in placed:
            end, T_world_end = step.b, moved[step.a] @ step.T_a_b
        else:
            end, T_world_end = step.a, moved[step.b] @ geometry.inverse(step.T_a_b)
        T_new_old = T_world_end @ geometry.inverse(moved[end])
        off_m = geometry.distance(geometry.inverse(moved[end]) @ T_world_end)
        if geometry.angle(T_new_old) > np.radians(BREAK_DEG) or off_m > BREAK_M:
            rows = segment == segment[end]
            moved[rows] = T_new_old @ moved[rows]
        placed.add(int(segment[end]))
    return moved
