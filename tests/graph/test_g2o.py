from pathlib import Path

import gtsam
import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.types import SegslamError
from segslam.graph.edges import Edge
from segslam.graph.g2o import G2oGraph, read_g2o, write_g2o

INFORMATION = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
VERTICES = ["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1", "VERTEX_SE3:QUAT 2 2 0 0 0 0 0 1"]
EDGES = [f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {INFORMATION}", f"EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 1 {INFORMATION}"]


def _file(folder: Path, lines: list[str]) -> Path:
    path = folder / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


def _random_graph(rng: np.random.Generator) -> G2oGraph:
    def move() -> np.ndarray:
        return geometry.exp(geometry.tangent(rotation_rad=rng.normal(0, 1, 3), translation_m=rng.normal(0, 1000, 3)))

    def information() -> np.ndarray:
        root = rng.normal(size=(6, 6))
        return root @ root.T + np.eye(6)

    edges = [Edge(7, 3, move(), information()), Edge(3, 12, move(), information()), Edge(12, 7, move(), information())]
    return G2oGraph({7: move(), 3: move(), 12: move()}, edges, fixed=(3,))


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    graph = _random_graph(np.random.default_rng(0))
    write_g2o(tmp_path / "graph.g2o", graph)
    found = read_g2o(tmp_path / "graph.g2o")
    assert list(found.T_world_vertex) == [7, 3, 12]
    assert found.fixed == (3,)
    for vertex, T_world_vertex in graph.T_world_vertex.items():
        np.testing.assert_allclose(found.T_world_vertex[vertex], T_world_vertex, atol=1e-7, rtol=0)  # 12 digits of km
    for written, read in zip(graph.edges, found.edges, strict=True):
        assert (read.a, read.b) == (written.a, written.b)
        np.testing.assert_allclose(read.T_a_b, written.T_a_b, atol=1e-7, rtol=0)
        np.testing.assert_allclose(read.information, written.information, rtol=1e-9, atol=1e-9)


def test_gtsam_reads_what_is_written_as_we_meant_it(tmp_path: Path) -> None:
    """The order of the information and the direction of an edge, against another reader."""
    graph = _random_graph(np.random.default_rng(1))
    write_g2o(tmp_path / "graph.g2o", G2oGraph(graph.T_world_vertex, graph.edges))
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    np.testing.assert_allclose(values.atPose3(12).matrix(), graph.T_world_vertex[12], atol=1e-7, rtol=0)
    for i, edge in enumerate(graph.edges):
        factor = factors.at(i)
        assert list(factor.keys()) == [edge.a, edge.b]
        np.testing.assert_allclose(factor.measured().matrix(), edge.T_a_b, atol=1e-7, rtol=0)
        np.testing.assert_allclose(factor.noiseModel().information(), edge.information, rtol=1e-6, atol=1e-6)


def test_translation_comes_first_in_the_file_and_rotation_in_memory(tmp_path: Path) -> None:
    diagonal = "1 0 0 0 0 0 2 0 0 0 0 3 0 0 0 4 0 0 5 0 6"
    edge = f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {diagonal}"
    graph = read_g2o(_file(tmp_path, [*VERTICES[:2], edge]))
    np.testing.assert_array_equal(np.diag(graph.edges[0].information), [4, 5, 6, 1, 2, 3])


def test_empty_lines_comments_and_any_order_of_lines_are_read(tmp_path: Path) -> None:
    lines = ["# a graph", "", EDGES[0], VERTICES[1] + " # the second", *VERTICES[::2], "FIX 2", EDGES[1], "  "]
    graph = read_g2o(_file(tmp_path, lines))
    assert list(graph.T_world_vertex) == [1, 0, 2]
    assert [(edge.a, edge.b) for edge in graph.edges] == [(0, 1), (1, 2)]


def test_several_vertices_may_be_fixed_in_a_line_and_parameters_of_other_edges_are_ignored(tmp_path: Path) -> None:
    lines = ["PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", *VERTICES, *EDGES, "FIX 0 2"]
    assert read_g2o(_file(tmp_path, lines)).fixed == (0, 2)


def test_a_single_vertex_is_a_graph(tmp_path: Path) -> None:
    assert read_g2o(_file(tmp_path, VERTICES[:1])).edges == []


@pytest.mark.parametrize(
    ("line", "text", "complaint"),
    [
        (1, "VERTEX_SE3:QUAT 1 1 0 0 0 0 0", "takes 8 numbers, found 7"),
        (1, "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 one", "could not convert string to float: 'one'"),
        (1, "VERTEX_SE3:QUAT 1.5 1 0 0 0 0 0 1", "invalid literal for int"),
        (1, f"VERTEX_SE3:QUAT {2**63} 1 0 0 0 0 0 1", "ids are at least 0 and below"),
        (1, f"VERTEX_SE3:QUAT {2**64} 1 0 0 0 0 0 1", "ids are at least 0 and below"),
        (1, "VERTEX_SE3:QUAT -1 1 0 0 0 0 0 1", "ids are at least 0 and below"),
        (1, "VERTEX_SE3:QUAT 1 nan 0 0 0 0 0 1", "every number must be finite"),
        (1, "VERTEX_SE3:QUAT 1 1e200 0 0 0 0 0 1", "every number must be finite"),
        (1, "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 0", "quaternion's length is off by 1"),
        (1, "VERTEX_SE3:QUAT 0 1 0 0 0 0 0 1", "vertex 0 is in line 1 already"),
        (1, "VERTEX_SE2 1 1 0 0", "graph in the plane; only graphs in space"),
        (1, "VERTEX_TRACKXYZ 1 1 0 0", "VERTEX_TRACKXYZ; known are VERTEX_SE3:QUAT, EDGE_SE3:QUAT, FIX: remove all"),
        (3, EDGES[0][:-2], "takes 30 numbers, found 29"),
        (3, EDGES[0].replace("0 1 1", "0 1 inf", 1), "every number must be finite"),
        (3, EDGES[0].replace(INFORMATION, "-" + INFORMATION), "not positive definite"),
        (3, EDGES[0].replace(INFORMATION, "0" + INFORMATION[1:]), "not positive definite"),
        (3, EDGES[0].replace(" 0 1 1", " 0 9 1", 1), "vertex 9 has no VERTEX_SE3:QUAT line"),
        (3, EDGES[0].replace(" 0 1 1", " 1 1 1", 1), "ties vertex 1 to itself"),
        (3, "FIX 9", "vertex 9 has no VERTEX_SE3:QUAT line"),
        (3, "FIX", "takes 1 numbers, found 0"),
    ],
)
def test_a_broken_line_is_named(tmp_path: Path, line: int, text: str, complaint: str) -> None:
    lines = [*VERTICES, *EDGES]
    lines[line] = text
    with pytest.raises(SegslamError) as caught:
        read_g2o(_file(tmp_path, lines))
    assert str(caught.value).startswith(f"{tmp_path / 'graph.g2o'}:{line + 1}: ")
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_part_without_connection_is_named_by_its_first_vertex(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match=r"graph\.g2o:3: no chain of edges leads from vertex 0 to this one \(2 sep"):
        read_g2o(_file(tmp_path, [*VERTICES, EDGES[0]]))


@pytest.mark.parametrize("lines", [[], ["# nothing"]])
def test_a_file_without_vertices_is_refused(tmp_path: Path, lines: list[str]) -> None:
    with pytest.raises(SegslamError, match="holds no vertex"):
        read_g2o(_file(tmp_path, lines))


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match=r"nowhere\.g2o: no such file; give a g2o file"):
        read_g2o(tmp_path / "nowhere.g2o")
    (tmp_path / "binary.g2o").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(SegslamError, match=r"binary\.g2o: cannot read"):
        read_g2o(tmp_path / "binary.g2o")


@pytest.mark.data
def test_published_graphs_are_read_as_gtsam_reads_them(data_dir: Path) -> None:
    path = data_dir / "g2o" / "smallGrid3D.g2o"
    graph = read_g2o(path)
    factors, values = gtsam.readG2o(str(path), True)
    assert len(graph.edges) == factors.size()
    for vertex, T_world_vertex in graph.T_world_vertex.items():
        np.testing.assert_allclose(T_world_vertex, values.atPose3(vertex).matrix(), atol=1e-12)
    for i, edge in enumerate(graph.edges):
        np.testing.assert_allclose(edge.T_a_b, factors.at(i).measured().matrix(), atol=1e-12)
        np.testing.assert_allclose(edge.information, factors.at(i).noiseModel().information(), rtol=1e-9, atol=1e-9)
