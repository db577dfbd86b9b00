import json
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np
import pytest
from helpers import commands
from scipy.spatial.transform import Rotation

from segslam.core import geometry
from segslam.core.types import SegslamError
from segslam.graph import batch_search
from segslam.graph.batch import optimize_graph
from segslam.graph.edges import Edge, factor_graph
from segslam.graph.g2o import G2oGraph, read_g2o, write_g2o

TIGHT = np.diag(geometry.tangent(rotation_rad=0.01, translation_m=0.05) ** -2.0)


def square(*, num_false: int = 0) -> tuple[G2oGraph, np.ndarray]:
    """Three rounds of a square of 12 m, 4 vertices a side, with exact edges; guesses drift. And the true poses."""
    truth = []
    for i in range(36):
        side, along = divmod(i % 12, 3)
        corner = np.array([[0, 0], [12, 0], [12, 12], [0, 12]])[side]
        heading = side * np.pi / 2
        position = corner + 4.0 * along * np.array([np.cos(heading), np.sin(heading)])
        truth.append(geometry.transform(geometry.yaw(heading), [*position, 0.0]))
    pairs = [(i, i + 1) for i in range(35)] + [(i, i + 12) for i in range(0, 24, 3)]
    edges = [Edge(a, b, geometry.inverse(truth[a]) @ truth[b], TIGHT) for a, b in pairs]
    edges += [Edge(i, i + 17, geometry.transform(geometry.yaw(1.0), [5.0, 5.0, 2.0]), TIGHT) for i in range(num_false)]
    drift = geometry.exp(geometry.tangent(rotation_rad=[0, 0, 0.01], translation_m=[0.1, 0, 0]))
    guesses, T_world_guess = {0: truth[0]}, truth[0]
    for edge in edges[:35]:
        T_world_guess = T_world_guess @ edge.T_a_b @ drift
        guesses[edge.b] = T_world_guess
    return G2oGraph(guesses, edges), np.array(truth)


Optimize = Callable[..., "Ended"]


class Ended(NamedTuple):
    """Exit status and output of a command, including that of libraries."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Optimize:
    """Runs `segslam optimize`."""
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # pytest's would take the warnings

    def ended(*arguments: object) -> Ended:
        return Ended(commands.run("optimize", *arguments), *capfd.readouterr())

    return ended


def poses(graph: G2oGraph) -> np.ndarray:
    return np.array(list(graph.T_world_vertex.values()))


@pytest.mark.parametrize("robust", ["none", "cauchy"])
def test_a_result_is_judged_by_the_edges_that_it_may_not_leave_out(robust: str) -> None:
    graph, _ = square(num_false=1)
    found = optimize_graph(graph, robust=robust)
    assert found.num_outliers >= 1
    assert found.chi2_per_dof is not None
    everything = 2.0 * found.final_error / (6 * (len(graph.edges) - len(graph.T_world_vertex) + 1))
    if robust == "none":
        assert found.chi2_per_dof == pytest.approx(everything, rel=1e-6)
    else:
        assert found.chi2_per_dof < 0.1 * everything


@pytest.mark.parametrize("robust", ["none", "huber", "cauchy", "geman-mcclure", "gnc", "consistent"])
def test_exact_edges_give_the_exact_poses(robust: str) -> None:
    graph, truth = square()
    result = optimize_graph(graph, robust=robust)
    np.testing.assert_allclose(poses(result.graph), truth, atol=1e-4)
    assert result.initial_error > 1.0
    assert result.final_error < 1e-6
    assert result.iterations > 0
    assert result.num_outliers == 0


@pytest.mark.parametrize("robust", ["gnc", "consistent"])
def test_false_edges_are_rejected(robust: str) -> None:
    graph, truth = square(num_false=4)
    all_kept, found = optimize_graph(graph, robust="none"), optimize_graph(graph, robust=robust)
    assert np.abs(poses(all_kept.graph) - truth).max() > 0.1
    assert not all_kept.converged
    np.testing.assert_allclose(poses(found.graph), truth, atol=1e-4)
    assert found.num_outliers == 4
    assert found.outliers == tuple((i, i + 17) for i in range(4))
    assert found.converged


def test_a_group_of_false_edges_that_are_consistent_with_each_other_is_rejected() -> None:
    graph, truth = square()
    T_moved = geometry.transform(geometry.yaw(0.5), [3.0, 1.0, 0.0])
    false = [Edge(i, i + 12, T_moved @ geometry.inverse(truth[i]) @ truth[i + 12], TIGHT) for i in (13, 14, 16, 17)]
    found = optimize_graph(G2oGraph(graph.T_world_vertex, graph.edges + false))
    np.testing.assert_allclose(poses(found.graph), truth, atol=1e-4)
    assert found.outliers == tuple((edge.a, edge.b) for edge in false)


def test_of_more_closures_than_are_compared_pairwise_graduated_non_convexity_selects(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    graph, truth = square(num_false=4)
    for most, is_graduated in ((12, False), (11, True)):
        caplog.clear()
        monkeypatch.setattr(batch_search, "MAX_PAIRED", most)
        found = optimize_graph(graph)
        np.testing.assert_allclose(poses(found.graph), truth, atol=1e-4)
        assert ("graduated non-convexity" in caplog.text) is is_graduated


def test_odometry_may_be_written_backwards_twice_and_from_any_id() -> None:
    graph, truth = square(num_false=4)
    turned = [
        Edge(e.b + 7, e.a + 7, geometry.inverse(e.T_a_b), e.information)
        if e.a % 3 == 0 and e.b == e.a + 1
        else Edge(e.a + 7, e.b + 7, e.T_a_b, e.information)
        for e in graph.edges
    ]
    guesses = {i + 7: T for i, T in graph.T_world_vertex.items()}
    found = optimize_graph(G2oGraph(guesses, [*turned, turned[4]]))
    np.testing.assert_allclose(poses(found.graph), truth, atol=1e-4)
    assert found.outliers == tuple((i + 7, i + 24) for i in range(4))


@pytest.mark.parametrize("robust", ["none", "huber", "cauchy", "geman-mcclure", "gnc", "consistent"])
def test_errors_are_half_the_chi_square_under_every_kernel(robust: str) -> None:
    """Odometry that disagrees with the closures: no kernel's cost is the chi-square."""
    graph, _ = square()
    long = geometry.exp(geometry.tangent(rotation_rad=[0.0, 0.0, 0.01], translation_m=[0.02, 0.0, 0.0]))
    edges = [Edge(e.a, e.b, e.T_a_b @ long, e.information) if e.b == e.a + 1 else e for e in graph.edges]
    found = optimize_graph(G2oGraph(graph.T_world_vertex, edges), robust=robust)
    factors = factor_graph(edges)

    def error(at: G2oGraph) -> float:
        values = gtsam.Values()
        for vertex, T_world_vertex in at.T_world_vertex.items():
            values.insert(vertex, gtsam.Pose3(T_world_vertex))
        return float(factors.error(values))

    assert found.num_outliers == 0
    assert found.initial_error == pytest.approx(error(graph), rel=1e-9)
    assert found.final_error == pytest.approx(error(found.graph), rel=1e-6)
    assert (found.robust_cost is None) == (robust in ("none", "gnc", "consistent"))
    if robust in ("cauchy", "geman-mcclure"):
        assert found.robust_cost is not None
        assert found.robust_cost < (1.0 - 1e-6) * found.final_error


def test_a_result_that_does_not_fit_is_reported() -> None:
    """Odometry is always kept: with one wrong motion, nothing fits."""
    graph, _ = square()
    wrong = graph.edges[20]
    edges = [Edge(e.a, e.b, np.eye(4), e.information) if e is wrong else e for e in graph.edges]
    found = optimize_graph(G2oGraph(graph.T_world_vertex, edges), robust="none")
    assert not found.converged
    assert "chi-square" in found.doubts[0]
    assert found.chi2_per_dof is not None
    assert found.chi2_per_dof > 5.0


def test_the_first_vertex_stays_where_it_is() -> None:
    graph, _ = square()
    T_new_world = geometry.transform(geometry.yaw(2.0), [100.0, 50.0, 3.0])
    moved = G2oGraph({i: T_new_world @ T for i, T in graph.T_world_vertex.items()}, graph.edges)
    result = optimize_graph(moved).graph
    np.testing.assert_allclose(result.T_world_vertex[0], moved.T_world_vertex[0], atol=1e-6)
    np.testing.assert_allclose(poses(result), T_new_world @ poses(optimize_graph(graph).graph), atol=1e-4)


def test_fixed_vertices_stay_where_they_are() -> None:
    graph, _ = square()
    result = optimize_graph(G2oGraph(graph.T_world_vertex, graph.edges, fixed=(0, 35))).graph
    for vertex in (0, 35):
        np.testing.assert_allclose(result.T_world_vertex[vertex], graph.T_world_vertex[vertex], atol=1e-2)


def test_a_bad_initial_guess_is_replaced() -> None:
    """All vertices at one place with random headings: the nearest optimum is wrong."""
    graph, truth = square()
    rng = np.random.default_rng(3)
    guesses = {i: geometry.transform(geometry.yaw(rng.uniform(-np.pi, np.pi)), np.zeros(3)) for i in range(1, 36)}
    result = optimize_graph(G2oGraph({0: truth[0]} | guesses, graph.edges))
    np.testing.assert_allclose(poses(result.graph), truth, atol=1e-4)


def test_without_a_chain_of_odometry_gnc_is_refused_and_consistent_becomes_cauchy(
    caplog: pytest.LogCaptureFixture,
) -> None:
    graph, truth = square()
    broken = G2oGraph(graph.T_world_vertex, [edge for edge in graph.edges if (edge.a, edge.b) != (4, 5)])
    optimize_graph(broken, robust="none")
    with pytest.raises(SegslamError, match="do not connect this graph"):
        optimize_graph(broken, robust="gnc")
    found = optimize_graph(broken, robust="consistent")
    assert found.robust == "cauchy"
    assert "--robust cauchy is used" in caplog.text
    np.testing.assert_allclose(poses(found.graph), truth, atol=1e-4)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "optimum"),
    [
        ("parking-garage", 0.634192),
        pytest.param("sphere2500", 675.701, marks=pytest.mark.slow),
        ("smallGrid3D", 517.925),
    ],
)
@pytest.mark.parametrize("robust", ["none", "consistent"])
def test_published_graphs_reach_their_known_optimum(data_dir: Path, name: str, optimum: float, robust: str) -> None:
    result = optimize_graph(read_g2o(data_dir / "g2o" / f"{name}.g2o"), robust=robust)
    assert result.final_error == pytest.approx(optimum, rel=1e-6)
    assert result.outliers == ()
    assert result.converged


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("group", [1, 10])
def test_three_hundred_false_edges_of_a_published_graph_are_all_found(data_dir: Path, group: int) -> None:
    """Relative poses drawn at random, alone or in groups of ten that are consistent with each other."""
    clean = read_g2o(data_dir / "g2o" / "sphere2500.g2o")
    optimum = np.array(list(optimize_graph(clean, robust="none").graph.T_world_vertex.values()))
    rng = np.random.default_rng(5)
    false: list[Edge] = []
    while len(false) < 300:
        a, b = np.sort(rng.choice(2500 - group, 2, replace=False)).tolist()
        if b - a <= 60:  # a ring has 50
            continue
        T_a_b = geometry.transform(Rotation.random(random_state=rng).as_matrix(), rng.normal(0.0, 30.0, 3))
        for k in range(group):
            T_ak_a, T_b_bk = (geometry.inverse(optimum[i]) @ optimum[j] for i, j in ((a + k, a), (b, b + k)))
            false.append(Edge(a + k, b + k, T_ak_a @ T_a_b @ T_b_bk, clean.edges[-1].information))
    found = optimize_graph(G2oGraph(clean.T_world_vertex, clean.edges + false))
    assert set(found.outliers) == {(edge.a, edge.b) for edge in false}
    assert found.final_error == pytest.approx(675.701, rel=1e-5)
    assert found.converged


def test_the_command_prints_the_robust_cost_and_reports_doubtful_results(run: Optimize, tmp_path: Path) -> None:
    graph, _ = square()
    wrong = [Edge(e.a, e.b, np.eye(4), e.information) if e is graph.edges[20] else e for e in graph.edges]
    write_g2o(tmp_path / "in.g2o", G2oGraph(graph.T_world_vertex, wrong))
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "out0.g2o", "--robust", "cauchy")
    assert done.returncode == 0
    assert "cost under the kernel cauchy: " in done.stderr
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "out1.g2o", "--robust", "none", "--json")
    assert json.loads(done.stdout)["converged"] is False
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "out2.g2o", "--robust", "none")
    assert "the result may be wrong: the edges fit worse" in done.stderr


def test_the_command_writes_the_optimum_and_prints_one_json_object(run: Optimize, tmp_path: Path) -> None:
    graph, truth = square()
    write_g2o(tmp_path / "in.g2o", graph)
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "out.g2o", "--json")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert {"initial_error", "final_error", "iterations", "seconds", "num_outliers"} < set(figures)
    assert figures["robust"] == "consistent"
    assert figures["converged"] is True
    assert figures["chi2_max"] < 1e-6
    np.testing.assert_allclose(poses(read_g2o(tmp_path / "out.g2o")), truth, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "arguments", "complaint"),
    [
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0\n", [], "in.g2o:1: "),
        ("", [], "in.g2o: holds no vertex"),
        (None, [], "in.g2o: no such file; give a g2o file"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", ["--robust", "magic"], "magic"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    run: Optimize, tmp_path: Path, text: str | None, arguments: list[str], complaint: str
) -> None:
    if text is not None:
        (tmp_path / "in.g2o").write_text(text)
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "out.g2o", *arguments)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out.g2o").exists()


def test_a_missing_folder_for_the_result_is_found_before_the_work(run: Optimize, tmp_path: Path) -> None:
    (tmp_path / "in.g2o").write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n")
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "nowhere" / "out.g2o")
    assert done.returncode == 2
    assert "no folder" in done.stderr


@pytest.mark.parametrize("robust", ["none", "gnc", "consistent"])
def test_a_graph_that_cannot_be_solved_is_one_line_with_its_vertex(run: Optimize, tmp_path: Path, robust: str) -> None:
    graph, _ = square()
    edges = [*graph.edges]
    far = edges[3].T_a_b.copy()
    far[2, 3] = 1e12
    edges[3] = Edge(3, 4, far, TIGHT)
    write_g2o(tmp_path / "in.g2o", G2oGraph(graph.T_world_vertex, edges))
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "out.g2o", "--robust", robust)
    assert done.returncode == 2
    assert re.fullmatch(r"(?s).*in\.g2o: the poses near vertex \d+ cannot be computed: [^\n]*\n", done.stderr)
