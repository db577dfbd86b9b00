"""Pose graphs as g2o text: the tags VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX. PARAMS lines belong to other edges.

A vertex is `id x y z qx qy qz qw`; an edge is `a b`, the pose of b in a as for a vertex, and the upper triangle of its
information, row by row. g2o puts translation before rotation, segslam after it: only this module converts.
Like GTSAM, it uses the rotational part of the information as it is.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import SupportsIndex

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core.errors import brief
from segslam.core.trajectory import LARGEST, NOT_FINITE, ROTATION_TOLERANCE, Poses, from_quaternions
from segslam.core.types import Indices, SegslamError, Transform
from segslam.core.whole_files import read_text
from segslam.graph.edges import Edge

VERTEX, EDGE, FIX = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "FIX"
NUM_FIELDS = {VERTEX: 8, EDGE: 30, FIX: 1}
"""Ids included, the tag not."""
UNUSED = "PARAMS_"
"""Begin of the tags of sensor offsets and cameras, which edges between poses do not use."""
UPPER = np.triu_indices(6)
OTHER_ORDER = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
"""Turns [translation; rotation] into [rotation; translation], and back."""


@dataclass(frozen=True, slots=True, eq=False)
class G2oGraph:
    """Contents of a g2o file."""

    T_world_vertex: dict[int, Transform]
    """Poses of the vertices by id, as in the file."""
    edges: list[Edge]
    fixed: tuple[int, ...] = ()
    """Vertices that FIX lines name."""


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """The lines of one tag, a row each."""

    path: Path
    line_numbers: list[int]
    ids: list[list[int]]
    numbers: list[list[float]]

    def add(self, line_number: int, texts: list[str], *, num_ids: int) -> None:
        """Add a row; raises SegslamError for texts that are no ids, or no finite numbers."""
        self.line_numbers.append(line_number)
        try:
            self.ids.append([int(text) for text in texts[:num_ids]])
            self.numbers.append([float(text) for text in texts[num_ids:]])
        except ValueError as error:
            raise self.refusal(-1, brief(str(error))) from error
        if not 0 <= min(self.ids[-1]) <= max(self.ids[-1]) < 2**63:
            raise self.refusal(-1, "ids are at least 0 and below 2**63")
        if not all(abs(number) <= LARGEST for number in self.numbers[-1]):
            raise self.refusal(-1, NOT_FINITE)

    def refusal(self, row: SupportsIndex, what: str) -> SegslamError:
        return SegslamError(f"{self.path}:{self.line_numbers[row]}: {what}; correct or remove the line")


def read_g2o(path: Path) -> G2oGraph:
    """The pose graph of a file, every line checked.

    Raises SegslamError that names file and line: an unknown tag, a broken line, a vertex missing or twice there,
    an information that is not positive definite, a vertex without a chain of edges to the first, no vertex at all.
    """
    vertices, edges, fixes = _read_tables(path)
    if not vertices.ids:
        raise SegslamError(f"{path}: holds no vertex; a graph needs lines of {VERTEX}")
    row_of: dict[int, int] = {}
    for row, (vertex,) in enumerate(vertices.ids):
        if row_of.setdefault(vertex, row) != row:
            raise vertices.refusal(row, f"vertex {vertex} is in line {vertices.line_numbers[row_of[vertex]]} already")
    for table in (edges, fixes):
        for row, vertex in ((row, vertex) for row, ids in enumerate(table.ids) for vertex in ids):
            if vertex not in row_of:
                raise table.refusal(row, f"vertex {vertex} has no {VERTEX} line")
    graph = G2oGraph(
        dict(zip(row_of, _poses(vertices), strict=True)), _edges(edges), tuple(ids[0] for ids in fixes.ids)
    )
    part = parts(row_of, graph.edges)
    if part.any():
        what = f"no chain of edges leads from vertex {vertices.ids[0][0]} to this one ({part.max() + 1} separate parts)"
        raise vertices.refusal(int(np.argmax(part > 0)), what)
    return graph


def write_g2o(path: Path, graph: G2oGraph) -> None:
    """Vertices, fixed vertices, edges: numbers to twelve digits, where GTSAM's writer keeps six."""
    vertex_texts = _pose_texts(graph.T_world_vertex.values())
    edge_texts = _pose_texts(edge.T_a_b for edge in graph.edges)
    lines = [f"{VERTEX} {i} {pose}" for i, pose in zip(graph.T_world_vertex, vertex_texts, strict=True)]
    lines += [f"{FIX} {i}" for i in graph.fixed]
    lines += [
        f"{EDGE} {edge.a} {edge.b} {pose} {_text(edge.information[OTHER_ORDER][UPPER])}"
        for edge, pose in zip(graph.edges, edge_texts, strict=True)
    ]
    path.write_text("".join(line + "\n" for line in lines), encoding="ascii")


def parts(vertices: Iterable[int], edges: Iterable[Edge]) -> Indices:
    """Which part each vertex belongs to, that of the first being 0; within a part, chains of edges lead everywhere."""
    position = {vertex: i for i, vertex in enumerate(vertices)}
    pairs = np.array([(position[edge.a], position[edge.b]) for edge in edges], dtype=np.int64).reshape(-1, 2)
    adjacency = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(position), len(position)))
    return connected_components(adjacency, directed=False)[1]


def _read_tables(path: Path) -> tuple[_Table, _Table, _Table]:
    """The lines with vertices, edges and fixed vertices, each line checked by itself."""
    text = read_text(path, "pose graph", "give a g2o file")
    tables = {tag: _Table(path, [], [], []) for tag in (VERTEX, EDGE, FIX)}
    for number, line in enumerate(text.split("\n"), start=1):
        tag, *texts = line.partition("#")[0].split() or [""]
        if not tag or tag.startswith(UNUSED):
            continue
        rows = [[text] for text in texts] if tag == FIX and texts else [texts]  # FIX may name several vertices
        for row in rows:
            if len(row) != NUM_FIELDS.get(tag):
                raise SegslamError(f"{path}:{number}: {_complaint(tag, len(row))}")
            tables[tag].add(number, row, num_ids=2 if tag == EDGE else 1)
    return tables[VERTEX], tables[EDGE], tables[FIX]


def _complaint(tag: str, num_fields: int) -> str:
    if tag in ("VERTEX_SE2", "EDGE_SE2"):
        return f"{tag} belongs to a graph in the plane; only graphs in space ({VERTEX}, {EDGE}) can be read"
    if tag not in NUM_FIELDS:
        return f"unknown tag {brief(tag)}; known are {', '.join(NUM_FIELDS)}: remove all lines with it"
    return f"{tag} takes {NUM_FIELDS[tag]} numbers, found {num_fields}; correct or remove the line"


def _poses(table: _Table) -> Poses:
    """Those of the first seven numbers of each row."""
    poses, off = from_quaternions(np.array([row[:7] for row in table.numbers]).reshape(-1, 7))
    for row in np.flatnonzero(off > ROTATION_TOLERANCE):
        raise table.refusal(row, f"the quaternion's length is off by {off[row]:.3g}")
    return poses


def _edges(table: _Table) -> list[Edge]:
    triangles = np.zeros((len(table.ids), 6, 6))
    triangles[:, *UPPER] = np.array([row[7:] for row in table.numbers]).reshape(-1, len(UPPER[0]))
    information = triangles + np.triu(triangles, 1).transpose(0, 2, 1)
    smallest = np.linalg.eigvalsh(information)[:, 0]
    for flat in np.flatnonzero(smallest <= 0.0):
        raise table.refusal(flat, f"the information is not positive definite (an eigenvalue is {smallest[flat]:.3g})")
    edges = []
    for row, ((a, b), T_a_b) in enumerate(zip(table.ids, _poses(table), strict=True)):
        if a == b:
            raise table.refusal(row, f"the edge ties vertex {a} to itself")
        edges.append(Edge(a, b, T_a_b, information[row][OTHER_ORDER]))
    return edges


def _pose_texts(T_a_b: Iterable[Transform]) -> list[str]:
    poses = np.array(list(T_a_b)).reshape(-1, 4, 4)
    quaternions = ScipyRotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    return [_text(row) for row in np.column_stack([poses[:, :3, 3], quaternions])]


def _text(numbers: np.ndarray) -> str:
    return " ".join([f"{number:.12g}" for number in numbers.tolist()])
