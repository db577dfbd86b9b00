import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from segslam import geometry
from segslam.pose_graph import G2oGraph, optimize_graph, read_g2o, write_g2o
from segslam.pose_graph.edges import Edge
from segslam.types import SegslamError

TIGHT = np.diag(geometry.tangent(rotation_rad=0.01, translation_m=0.05) ** -2.0)


def square(*, lies: int = 0) -> tuple[G2oGraph, np.ndarray]:
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
    edges += [Edge(i, i + 17, geometry.transform(geometry.yaw(1.0), [5.0, 5.0, 2.0]), TIGHT) for i in range(lies)]
    drift = geometry.exp(geometry.tangent(rotation_rad=[0, 0, 0.01], translation_m=[0.1, 0, 0]))
    guesses, T_world_guess = {0: truth[0]}, truth[0]
    for edge in edges[:35]:
        T_world_guess = T_world_guess @ edge.T_a_b @ drift
        guesses[edge.b] = T_world_guess
    return G2oGraph(guesses, edges), np.array(truth)


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "segslam", "optimize", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def poses(graph: G2oGraph) -> np.ndarray:
    return np.array(list(graph.T_world_vertex.values()))


@pytest.mark.parametrize("robust", ["none", "huber", "cauchy", "geman-mcclure", "gnc"])
def test_exact_edges_bring_every_vertex_home(robust: str) -> None:
    graph, truth = square()
    result = optimize_graph(graph, robust=robust)
    np.testing.assert_allclose(poses(result.graph), truth, atol=1e-4)
    assert result.initial_error > 1.0
    assert result.final_error < 1e-6
    assert result.iterations > 0
    assert result.num_outliers == 0


def test_gnc_finds_the_lies() -> None:
    graph, truth = square(lies=4)
    believed, doubted = optimize_graph(graph, robust="none"), optimize_graph(graph, robust="gnc")
    assert np.abs(poses(believed.graph) - truth).max() > 0.1
    np.testing.assert_allclose(poses(doubted.graph), truth, atol=1e-4)
    assert doubted.num_outliers == 4


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


def test_a_hopeless_guess_is_replaced_by_a_better_one() -> None:
    """All vertices at one place with random headings: the nearest optimum is none of the graph's."""
    graph, truth = square()
    rng = np.random.default_rng(3)
    guesses = {i: geometry.transform(geometry.yaw(rng.uniform(-np.pi, np.pi)), np.zeros(3)) for i in range(1, 36)}
    result = optimize_graph(G2oGraph({0: truth[0]} | guesses, graph.edges))
    np.testing.assert_allclose(poses(result.graph), truth, atol=1e-4)


def test_gnc_wants_a_chain_of_odometry() -> None:
    graph, _ = square()
    broken = G2oGraph(graph.T_world_vertex, [edge for edge in graph.edges if (edge.a, edge.b) != (4, 5)])
    optimize_graph(broken, robust="none")
    with pytest.raises(SegslamError, match="gnc trusts odometry"):
        optimize_graph(broken, robust="gnc")


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "optimum"), [("parking-garage", 0.634192), ("sphere2500", 675.701), ("smallGrid3D", 517.925)]
)
def test_published_graphs_reach_their_known_optimum(data_dir: Path, name: str, optimum: float) -> None:
    result = optimize_graph(read_g2o(data_dir / "g2o" / f"{name}.g2o"))
    assert result.final_error == pytest.approx(optimum, rel=1e-6)


def test_the_command_writes_the_optimum_and_prints_one_json_object(tmp_path: Path) -> None:
    graph, truth = square()
    write_g2o(tmp_path / "in.g2o", graph)
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "out.g2o", "--json")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert set(figures) == {"initial_error", "final_error", "iterations", "seconds", "num_outliers"}
    np.testing.assert_allclose(poses(read_g2o(tmp_path / "out.g2o")), truth, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "arguments", "complaint"),
    [
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0\n", [], "in.g2o:1: "),
        ("", [], "in.g2o: holds no vertex"),
        (None, [], "in.g2o: cannot read"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", ["--robust", "magic"], "magic"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    tmp_path: Path, text: str | None, arguments: list[str], complaint: str
) -> None:
    if text is not None:
        (tmp_path / "in.g2o").write_text(text)
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "out.g2o", *arguments)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out.g2o").exists()


def test_a_missing_folder_for_the_result_is_found_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "in.g2o").write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n")
    done = run(tmp_path / "in.g2o", "--out", tmp_path / "nowhere" / "out.g2o")
    assert done.returncode == 2
    assert "no folder" in done.stderr
