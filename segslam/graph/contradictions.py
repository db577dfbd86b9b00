"""Edges between the same neighbours that contradict each other: which of them is correct, only the other edges show."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from segslam.core import geometry
from segslam.graph import noise
from segslam.graph.closure_pairs import adjoints
from segslam.graph.edges import Edge

CONSISTENT = 0.999
"""Two correct measurements of one motion differ by less than this quantile of the chi-square distribution. Chosen."""


def contradicting(odometry: Sequence[Edge]) -> list[list[Edge]]:
    """Groups of edges between the same two vertices of which at least two differ by more than their noise allows."""
    same: dict[int, list[Edge]] = defaultdict(list)
    for edge in odometry:
        same[min(edge.a, edge.b)].append(edge)
    bound = noise.inlier_bound(CONSISTENT)
    return [edges for edges in same.values() if any(_chi2(one, other) > bound for one, other in combinations(edges, 2))]


def unknown_motion(edges: Sequence[Edge]) -> Edge:
    """An edge between the same vertices that connects them, with next to no information."""
    return Edge(edges[0].a, edges[0].b, edges[0].T_a_b, noise.UNKNOWN_MOTION)


def turned(edge: Edge) -> Edge:
    """The same measurement from the other vertex."""
    turn = adjoints(geometry.inverse(edge.T_a_b)[None])[0]  # of information: the inverse transposed of covariances'
    return Edge(edge.b, edge.a, geometry.inverse(edge.T_a_b), turn.T @ edge.information @ turn)


def _chi2(one: Edge, other: Edge) -> float:
    """Chi-square of the difference between two measurements of one motion."""
    same_way = other if other.a == one.a else turned(other)
    difference = geometry.log(geometry.inverse(one.T_a_b) @ same_way.T_a_b)
    covariance = np.linalg.inv(one.information) + np.linalg.inv(same_way.information)
    return float(difference @ np.linalg.solve(covariance, difference))
