"""The optimum of a finished graph with measured positions: position fixes of a receiver in a frame of the Earth."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.sparse.linalg import splu

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Indices, Points
from segslam.graph.edges import Edge, factor_graph, jacobian, poses_by_id, values_of
from segslam.graph.levenberg_marquardt import search

GAUGE = geometry.tangent(rotation_rad=[0.1, 0.1, 10.0], translation_m=1e4)
"""Standard deviations of the first pose. Chosen: more than the start is off by, so that it only holds what no fix
determines; 0.1 rad of tilt where heights are unknown."""
HELD = geometry.tangent(rotation_rad=1e-4, translation_m=1e-2)
"""The same where the placement of the drive is among the unknowns: they hold the first pose."""
LEAST_PRECISION = 1e-12


class PositionedGraph:
    """Poses of a drive in a frame of the Earth, from the edges of its graph and measured positions."""

    def __init__(self, edges: Sequence[Edge], T_map: Poses) -> None:
        """`edges` of a graph whose optimum are the poses `T_map` (k, 4, 4).

        Every edge gets its value at this optimum: the sum of squares then has the same second derivatives as the graph,
        and its minimum, without fixes, at the poses of the run.
        """
        self._factors = factor_graph(
            replace(edge, T_a_b=geometry.nearest_transform(geometry.inverse(T_map[edge.a]) @ T_map[edge.b]))
            for edge in edges
        )
        held, values = gtsam.NonlinearFactorGraph(self._factors), values_of(T_map)
        held.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Diagonal.Sigmas(HELD)))
        derivatives, _ = jacobian(held, values)
        self._information = splu((derivatives.T @ derivatives).tocsc())

    def covariance(self, derivatives: np.ndarray) -> np.ndarray:
        """(m, m) covariance, by the graph alone, of values with these `derivatives` (m, 6 k) by the poses' tangents."""
        covariance = derivatives @ self._information.solve(np.ascontiguousarray(derivatives.T))
        return (covariance + covariance.T) / 2

    def solve(self, start: Poses, keys: Indices, points: Points, positions: Points, precisions: Points) -> Poses:
        """(k, 4, 4) poses for fixes that measure `positions` (n, 3) of `points` (n, 3) in the frames of poses `keys`.

        `precisions` (n, 3): inverse variance of each axis (1 / m^2); 0 for an unknown one. Raises Unsolvable.
        """
        graph = gtsam.NonlinearFactorGraph(self._factors)
        first = gtsam.Pose3(geometry.nearest_transform(start[0]))
        graph.add(gtsam.PriorFactorPose3(0, first, gtsam.noiseModel.Diagonal.Sigmas(GAUGE)))
        for key, point, position, precision in zip(keys, points, positions, precisions, strict=True):
            if precision.max() > LEAST_PRECISION:
                model = gtsam.noiseModel.Diagonal.Precisions(np.maximum(precision, LEAST_PRECISION))
                graph.add(gtsam.GPSFactorArm(int(key), np.nan_to_num(position), point, model))
        return poses_by_id(search(graph, values_of(start)).values)
