"""Several edges between the same neighbours, one of them false: the rest of the graph decides."""

import gtsam
import numpy as np
import pytest

from segslam.core import geometry
from segslam.graph import batch_search
from segslam.graph.batch import optimize_graph
from segslam.graph.batch_search import contradicting
from segslam.graph.edges import Edge
from segslam.graph.g2o import G2oGraph
from segslam.graph.levenberg_marquardt import Search

TIGHT = np.diag(geometry.tangent(rotation_rad=0.01, translation_m=0.05) ** -2.0)
NUM = 24


def ring() -> tuple[G2oGraph, np.ndarray]:
    """Two rounds of a circle of 12 vertices with exact edges, and its poses."""
    truth = np.array([_on_circle(2 * np.pi * k / 12) for k in range(NUM)])
    pairs = [(k, k + 1) for k in range(NUM - 1)] + [(k, k + 12) for k in range(0, 12, 2)]
    edges = [Edge(a, b, geometry.inverse(truth[a]) @ truth[b], TIGHT) for a, b in pairs]
    return G2oGraph(dict(enumerate(truth)), edges), truth


def _on_circle(angle: float) -> np.ndarray:
    return geometry.transform(geometry.yaw(angle), [8 * np.sin(angle), 8 * (1 - np.cos(angle)), 0.0])


def false_edge(edge: Edge, off_m: float) -> Edge:
    return Edge(edge.a, edge.b, edge.T_a_b @ geometry.transform(np.eye(3), [off_m, 0.0, 0.0]), TIGHT)


def backwards(edge: Edge) -> Edge:
    return Edge(edge.b, edge.a, geometry.inverse(edge.T_a_b), edge.information)


@pytest.mark.parametrize("off_m", [0.5, 3.4])
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("robust", ["gnc", "consistent"])
def test_of_two_contradicting_edges_the_one_that_fits_the_loops_is_kept(off_m: float, first: bool, robust: str) -> None:
    graph, truth = ring()
    false = false_edge(graph.edges[9], off_m)
    edges = [false, *graph.edges] if first else [*graph.edges, backwards(false)]
    found = optimize_graph(G2oGraph(graph.T_world_vertex, edges), robust=robust)
    np.testing.assert_allclose(np.array(list(found.graph.T_world_vertex.values())), truth, atol=1e-4)
    assert len(found.outliers) == 1
    assert set(found.outliers[0]) == {9, 10}
    assert found.converged


def test_contradicting_edges_across_which_no_loop_leads_are_reported() -> None:
    graph, _ = ring()
    edges = [edge for edge in graph.edges if edge.b < 22 or edge.b == edge.a + 1]
    found = optimize_graph(G2oGraph(graph.T_world_vertex, [*edges, false_edge(graph.edges[22], 3.4)]))
    assert "the edges between 22 and 23 contradict each other" in found.doubts[-1]


def test_a_kept_edge_that_fits_far_worse_than_the_others_is_reported_though_all_together_are_plausible() -> None:
    graph, truth = ring()
    exact = Edge(9, 11, geometry.inverse(truth[9]) @ truth[11], 1e4 * TIGHT)
    edges = [*graph.edges, exact]
    edges[9] = false_edge(graph.edges[9], 0.35)
    edges[10] = Edge(10, 11, graph.edges[10].T_a_b, 1e4 * TIGHT)
    [reported] = optimize_graph(G2oGraph(graph.T_world_vertex, edges), robust="none").doubts
    assert "the edge from 9 to 10 is kept with a chi-square of 4" in reported


def test_fixed_vertices_add_degrees_of_freedom() -> None:
    graph, _ = ring()
    poses, edges = graph.T_world_vertex, [edge for edge in graph.edges if edge.b == edge.a + 1]
    assert optimize_graph(G2oGraph(poses, edges, fixed=(0,))).chi2_per_dof is None
    both = optimize_graph(G2oGraph(poses, edges, fixed=(0, len(edges))))
    all_three = optimize_graph(G2oGraph(poses, edges, fixed=(0, 5, len(edges))))
    for found, fixed in ((both, 2), (all_three, 3)):
        assert found.chi2_per_dof == pytest.approx(2.0 * found.final_error / (6 * (fixed - 1)), rel=1e-6)


def test_repeated_edges_that_agree_are_odometry() -> None:
    graph, _ = ring()
    assert contradicting([graph.edges[3], backwards(graph.edges[3]), false_edge(graph.edges[3], 0.1)]) == []
    assert len(contradicting([graph.edges[3], false_edge(graph.edges[3], 0.5)])) == 1


@pytest.mark.parametrize("errors", [(90.0, 80.0), (80.0, 90.0), (25.0, 20.0)])
def test_of_the_optima_near_two_starts_the_better_one_is_returned(
    monkeypatch: pytest.MonkeyPatch, errors: tuple[float, float]
) -> None:
    near, chordal = gtsam.Values(), gtsam.Values()
    found = iter([Search(near, errors[0], 3), Search(chordal, errors[1], 4)])
    monkeypatch.setattr(batch_search, "search", lambda factors, start: next(found))
    monkeypatch.setattr(batch_search, "deeply", lambda size, compute: chordal)
    best = batch_search.least_squares(gtsam.NonlinearFactorGraph(), near, redundancy=6)
    assert best.error == min(errors)
    assert best.values is (chordal if errors[1] < errors[0] else near)
    assert best.iterations == 7
