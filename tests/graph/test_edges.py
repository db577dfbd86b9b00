"""Factors of edges and their derivatives."""

import gtsam
import numpy as np
from graph.test_pose_graph import circle

from segslam.core import geometry
from segslam.graph.edges import Edge, factor_graph, jacobian, squared_errors, values_of


def test_derivatives_predict_the_errors_of_moved_poses() -> None:
    rng = np.random.default_rng(3)
    poses = circle(6)
    information = np.diag([9.0, 4.0, 1.0, 25.0, 16.0, 36.0])
    edges = [
        Edge(a, b, geometry.inverse(poses[a]) @ poses[b] @ geometry.exp(rng.normal(scale=0.02, size=6)), information)
        for a, b in ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 5))
    ]
    graph, values = factor_graph(edges), values_of(poses)
    derivatives, errors = jacobian(graph, values)
    np.testing.assert_allclose(np.square(errors).reshape(-1, 6).sum(axis=1), squared_errors(graph, values))
    for scale in (1e-3, -1e-3):
        tangents = scale * rng.normal(size=(6, 6))
        moved = gtsam.Values()
        for key, tangent in enumerate(tangents):
            moved.insert(key, values.atPose3(key).retract(tangent))
        predicted = derivatives @ tangents.ravel() - errors
        np.testing.assert_allclose(
            np.square(predicted).reshape(-1, 6).sum(axis=1), squared_errors(graph, moved), rtol=1e-3, atol=1e-6
        )
