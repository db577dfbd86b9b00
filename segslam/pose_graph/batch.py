"""A whole pose graph at once, as it comes from a file."""

import logging
from dataclasses import dataclass
from time import perf_counter
from typing import Literal

import gtsam
from scipy.special import chdtrc

from segslam.pose_graph import gnc, noise
from segslam.pose_graph.edges import factor_graph, joined, poses_by_id, squared_errors
from segslam.pose_graph.g2o import G2oGraph, parts
from segslam.pose_graph.solver import Search, search
from segslam.types import SegslamError

logger = logging.getLogger(__name__)
Robust = Literal["none", "huber", "cauchy", "geman-mcclure", "gnc"]
SUSPICIOUS = 1e-6
"""A fit this unlikely, were every edge as good as it claims, is tried from another start too. Chosen."""


@dataclass(frozen=True, slots=True, eq=False)
class Optimized:
    """The optimum of a graph, and how it was reached."""

    graph: G2oGraph
    initial_error: float
    """Half the chi-square of all edges at the file's poses."""
    final_error: float
    """Of what was minimised: under the kernel where there is one, without the edges that GNC switched off."""
    iterations: int
    seconds: float
    """Of the search alone."""
    num_outliers: int
    """Closures whose chi-square at the end is above the bound of inliers."""


def optimize_graph(graph: G2oGraph, *, robust: Robust = "none", inlier_probability: float = 0.99) -> Optimized:
    """The optimum of a graph near the file's poses; least squares (`none`) looks further where those give no fit.

    Edges between consecutive ids count as odometry and are never doubted. All others are closures: under the kernel
    `robust`, or kept and switched off by graduated non-convexity (`gnc`). Raises SegslamError if odometry alone does
    not connect the graph for the latter.
    """
    start = _values(graph)
    odometry = [edge for edge in graph.edges if abs(edge.a - edge.b) == 1]
    closures = [edge for edge in graph.edges if abs(edge.a - edge.b) != 1]
    if robust == "gnc" and parts(graph.T_world_vertex, odometry).any():
        raise SegslamError("gnc trusts odometry, but edges between consecutive ids alone do not connect this graph")
    trusted, doubted = _anchors(graph, start), factor_graph(closures)
    trusted.push_back(factor_graph(odometry))
    bound = noise.inlier_bound(inlier_probability)
    started = perf_counter()
    if robust == "gnc":
        found = gnc.solve(gnc.TruncatedProblem(trusted, closures, bound), start).search
    elif robust == "none":
        found = _least_squares(joined(trusted, doubted), start, redundancy=_redundancy(graph))
    else:
        found = search(joined(trusted, factor_graph(closures, kernel=noise.kernel(robust, bound))), start)
    seconds = perf_counter() - started
    return Optimized(
        graph=_moved(graph, found.values),
        initial_error=joined(trusted, doubted).error(start),
        final_error=found.error,
        iterations=found.iterations,
        seconds=seconds,
        num_outliers=int((squared_errors(doubted, found.values) > bound).sum()),
    )


def _least_squares(factors: gtsam.NonlinearFactorGraph, start: gtsam.Values, *, redundancy: int) -> Search:
    """The optimum near `start`, or near chordal poses if the first is no fit and the second is better.

    Chordal initialisation: Carlone et al., "Initialization Techniques for 3D SLAM", ICRA 2015.
    """
    near = search(factors, start)
    if redundancy == 0 or chdtrc(redundancy, 2.0 * near.error) > SUSPICIOUS:
        return near
    logger.info("the optimum near the file's poses is no fit: looking from chordal poses too")
    other = search(factors, gtsam.InitializePose3.initialize(factors))
    best = min(near, other, key=lambda found: found.error)
    return best._replace(iterations=near.iterations + other.iterations)


def _redundancy(graph: G2oGraph) -> int:
    """Degrees of freedom that the measurements have beyond those of the poses."""
    return noise.DEGREES_OF_FREEDOM * (len(graph.edges) - len(graph.T_world_vertex) + 1)


def _values(graph: G2oGraph) -> gtsam.Values:
    values = gtsam.Values()
    for vertex, T_world_vertex in graph.T_world_vertex.items():
        values.insert(vertex, gtsam.Pose3(T_world_vertex))
    return values


def _anchors(graph: G2oGraph, start: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """What holds the world in place: the fixed vertices, or the first of the file."""
    anchors = gtsam.NonlinearFactorGraph()
    for vertex in graph.fixed or (next(iter(graph.T_world_vertex)),):
        anchors.add(gtsam.PriorFactorPose3(vertex, start.atPose3(vertex), noise.first_pose()))
    return anchors


def _moved(graph: G2oGraph, values: gtsam.Values) -> G2oGraph:
    poses = dict(zip(sorted(graph.T_world_vertex), poses_by_id(values), strict=True))
    return G2oGraph({vertex: poses[vertex] for vertex in graph.T_world_vertex}, graph.edges, graph.fixed)
