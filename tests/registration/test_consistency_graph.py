"""The consistency graph against plain NumPy, its invariances, and the authors' edges."""

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from segslam.core import geometry
from segslam.core.config import SegregatorConfig
from segslam.core.types import Transform
from segslam.registration.segregator.consistency_graph import consistency_graph as graph_of_length
from segslam.registration.segregator.correspondences import Correspondences

LENGTH_BOUND_M = 0.4
GATES = ["lengths", "invariant", "published"]


def consistency_graph(correspondences: Correspondences, *, config: SegregatorConfig) -> tuple[np.ndarray, np.ndarray]:
    """The adjacency, and its edges i < j in ascending order."""
    adjacency = graph_of_length(correspondences, length_bound_m=LENGTH_BOUND_M, config=config)
    flags = np.unpackbits(adjacency.view(np.uint8), axis=1, bitorder="little")
    return adjacency, np.argwhere(np.triu(flags))


def random_covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    roots = rng.normal(scale=0.5, size=(count, 3, 3))
    return roots @ np.swapaxes(roots, 1, 2)


def random_correspondences(seed: int, count: int = 70) -> Correspondences:
    """In a box small enough for lengths to agree often; every end is shared by some three correspondences."""
    rng = np.random.default_rng(seed)
    num_ends = max(1, count // 3)
    source, target = rng.uniform(-3, 3, size=(2, num_ends, 3))
    i, j = rng.integers(num_ends, size=(2, count))
    return Correspondences(
        source[i], target[j], random_covariances(rng, num_ends)[i], random_covariances(rng, num_ends)[j], i, j
    )


def turned(correspondences: Correspondences, T_new_source: Transform) -> Correspondences:
    R = T_new_source[:3, :3]
    return correspondences._replace(
        source=geometry.apply(T_new_source, correspondences.source),
        source_covariances=R @ correspondences.source_covariances @ R.T,
    )


def spectral_distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sum((np.sqrt(np.linalg.eigvalsh(a)) - np.sqrt(np.linalg.eigvalsh(b))) ** 2))


def wasserstein_shape(a: np.ndarray, b: np.ndarray) -> float:
    root = scipy.linalg.sqrtm(a)
    return float(np.trace(a + b - 2 * scipy.linalg.sqrtm(root @ b @ root)).real)


def plain_edges(c: Correspondences, gate: str, config: SegregatorConfig) -> list[list[int]]:
    found = []
    for i in range(len(c.source)):
        for j in range(i + 1, len(c.source)):
            lengths = np.linalg.norm(c.source[i] - c.source[j]), np.linalg.norm(c.target[i] - c.target[j])
            a = c.source_covariances[i] + c.source_covariances[j]
            b = c.target_covariances[i] + c.target_covariances[j]
            shape = {"lengths": lambda a, b: 0.0, "invariant": spectral_distance, "published": wasserstein_shape}[gate]
            if (
                c.source_index[i] != c.source_index[j]
                and c.target_index[i] != c.target_index[j]
                and abs(lengths[0] - lengths[1]) <= LENGTH_BOUND_M
                and shape(a, b) <= config.shape_bound_m2
            ):
                found.append([i, j])
    return found


@pytest.mark.parametrize("gate", GATES)
@pytest.mark.parametrize("seed", range(3))
def test_edges_are_those_of_plain_numpy(gate: str, seed: int) -> None:
    correspondences = random_correspondences(seed)
    config = SegregatorConfig(gate=gate, shape_bound_m2=0.8)
    _, edges = consistency_graph(correspondences, config=config)
    expected = plain_edges(correspondences, gate, config)
    assert len(expected) > 20
    assert edges.tolist() == expected
    assert len(edges) == len(expected)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65])
def test_any_number_of_correspondences_makes_a_symmetric_graph_without_loops(count: int) -> None:
    adjacency, _ = consistency_graph(random_correspondences(0, count), config=SegregatorConfig())
    bits = np.unpackbits(adjacency.view(np.uint8), axis=1, bitorder="little")
    assert len(adjacency) == count
    assert not bits[:, count:].any()
    assert np.array_equal(bits[:, :count], bits[:, :count].T)
    assert not np.diagonal(bits).any()


@pytest.mark.parametrize("gate", ["lengths", "invariant"])
def test_turning_the_source_changes_no_edge(gate: str) -> None:
    correspondences = random_correspondences(5)
    config = SegregatorConfig(gate=gate)
    T_new_source = geometry.exp(geometry.tangent(rotation_rad=[0.4, -0.9, 1.3], translation_m=[4.0, 5.0, 6.0]))
    before = consistency_graph(correspondences, config=config)[1]
    after = consistency_graph(turned(correspondences, T_new_source), config=config)[1]
    assert len(before) > 20
    assert np.array_equal(before, after)


def test_spectral_distance_is_the_least_shape_distance_over_rotations() -> None:
    """Why the invariant gate is right: no turn of the source brings the published distance below it."""
    rng = np.random.default_rng(1)
    a, b = random_covariances(rng, 2)
    rotations = [geometry.exp(geometry.tangent(rotation_rad=rng.normal(size=3) * 2, translation_m=0.0))[:3, :3]
                 for _ in range(300)]  # fmt: skip
    # Aligned principal axes attain it.
    rotations.append(np.linalg.eigh(b)[1] @ np.linalg.eigh(a)[1].T)
    least = min(wasserstein_shape(R @ a @ R.T, b) for R in rotations)
    assert least == pytest.approx(spectral_distance(a, b), abs=1e-6)


@pytest.mark.parametrize("gate", ["invariant", "published"])
def test_covariances_that_are_flat_or_round_or_nothing_are_compared_without_loss(gate: str) -> None:
    """Double and zero eigenvalues are where a closed form could go wrong."""
    shapes = np.array([np.zeros((3, 3)), np.eye(3), np.diag([1.0, 1.0, 0.0]), np.diag([4.0, 0.0, 0.0])])
    points = np.array([[0.0, 0, 0], [9.0, 0, 0], [0.0, 5, 0], [0.0, 0, 3]])
    rows = np.arange(4)
    same = Correspondences(points, points, shapes, shapes, rows, rows)
    _, edges = consistency_graph(same, config=SegregatorConfig(gate=gate, shape_bound_m2=1e-6))
    assert len(edges) == 6


def test_correspondences_that_share_an_end_are_never_joined() -> None:
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [5.0, 0, 0]])
    shapes = np.tile(np.eye(3), (3, 1, 1))
    apart = np.arange(3)
    shared = np.array([0, 0, 1])
    assert consistency_graph(Correspondences(points, points, shapes, shapes, apart, apart),
                             config=SegregatorConfig())[1].shape == (3, 2)  # fmt: skip
    for ends in [(shared, apart), (apart, shared)]:
        _, edges = consistency_graph(Correspondences(points, points, shapes, shapes, *ends), config=SegregatorConfig())
        assert edges.tolist() == [[0, 2], [1, 2]]


def test_shapes_that_are_no_numbers_join_nothing() -> None:
    correspondences = random_correspondences(0)
    broken = correspondences._replace(source_covariances=np.full_like(correspondences.source_covariances, np.nan))
    assert consistency_graph(broken, config=SegregatorConfig(gate="invariant"))[1].shape == (0, 2)


@pytest.mark.data
@pytest.mark.parametrize("pair", ["000000_000030", "000000_004413"])
def test_edges_of_real_correspondences_are_those_of_the_authors_program(data_dir: Path, pair: str) -> None:
    golden = np.load(data_dir / "golden" / f"{pair}_fixed_trunkDCVC.npz")
    source, target = golden["corr_src"], golden["corr_tgt"]
    correspondences = Correspondences(
        source,
        target,
        golden["corr_src_covs_used"].reshape(-1, 3, 3),
        golden["corr_tgt_covs_used"].reshape(-1, 3, 3),
        np.unique(source, axis=0, return_inverse=True)[1].reshape(-1),
        np.unique(target, axis=0, return_inverse=True)[1].reshape(-1),
    )
    config = SegregatorConfig(gate="published", shape_bound_m2=5.0)
    theirs = sorted(map(tuple, golden["edges"].tolist()))
    assert list(map(tuple, consistency_graph(correspondences, config=config)[1].tolist())) == theirs
