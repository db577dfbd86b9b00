"""Maximum cliques against networkx, by hypothesis; bounds, ties, real graphs."""

from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from segslam.registration.cliques import _greedy_clique, degeneracy_order, maximum_cliques, pack_rows

ENOUGH = 10_000_000


def random_graph(rng: np.random.Generator, count: int, density: float) -> np.ndarray:
    upper = np.triu(rng.random((count, count)) < density, 1)
    return upper | upper.T


def all_maximum(flags: np.ndarray) -> set[tuple[int, ...]]:
    cliques = [tuple(sorted(clique)) for clique in nx.find_cliques(nx.from_numpy_array(flags))]
    return {clique for clique in cliques if len(clique) == max(map(len, cliques))}


def as_set(cliques: tuple[np.ndarray, ...]) -> set[tuple[int, ...]]:
    return {tuple(clique.tolist()) for clique in cliques}


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 70), density=st.sampled_from([0.0, 0.05, 0.3, 0.6, 0.9, 1.0]))
def test_one_and_all_maximum_cliques_are_those_of_networkx(seed: int, count: int, density: float) -> None:
    count = min(count, 30) if density > 0.5 else count  # a dense graph has too many cliques to list them all
    flags = random_graph(np.random.default_rng(seed), count, density)
    expected = all_maximum(flags)
    one = maximum_cliques(pack_rows(flags), max_cliques=1, max_nodes=ENOUGH)
    every = maximum_cliques(pack_rows(flags), max_cliques=5000, max_nodes=ENOUGH)
    assert as_set(one) <= expected
    assert len(every) == len(expected)
    assert as_set(every) == expected


@pytest.mark.parametrize(("count", "density"), [(300, 0.05), (300, 0.3), (200, 0.5)])
def test_size_in_larger_graphs_is_that_of_networkx(count: int, density: float) -> None:
    flags = random_graph(np.random.default_rng(count), count, density)
    size = len(nx.max_weight_clique(nx.from_numpy_array(flags), weight=None)[0])
    search = maximum_cliques(pack_rows(flags), max_cliques=1, max_nodes=ENOUGH)
    assert len(search[0]) == size


@pytest.mark.parametrize(("count", "density"), [(1, 0.0), (50, 0.0), (100, 0.1), (100, 0.5), (60, 1.0)])
def test_core_numbers_are_those_of_networkx_and_the_order_takes_the_least_connected_first(
    count: int, density: float
) -> None:
    flags = random_graph(np.random.default_rng(count), count, density)
    order, core_numbers = degeneracy_order(pack_rows(flags))
    assert dict(enumerate(core_numbers.tolist())) == nx.core_number(nx.from_numpy_array(flags))
    left = flags.copy()
    for v in order:
        assert left[v].sum() <= core_numbers[v]
        left[v, :] = left[:, v] = False


def test_planted_clique_is_found_among_a_thousand_vertices() -> None:
    rng = np.random.default_rng(0)
    flags = random_graph(rng, 1000, 0.1)
    planted = np.sort(rng.permutation(1000)[:25])
    flags[np.ix_(planted, planted)] = ~np.eye(25, dtype=bool)
    search = maximum_cliques(pack_rows(flags), max_cliques=3, max_nodes=ENOUGH)
    assert [clique.tolist() for clique in search] == [planted.tolist()]


def test_graph_without_vertices_has_no_clique() -> None:
    search = maximum_cliques(np.empty((0, 0), np.uint64), max_cliques=3, max_nodes=ENOUGH)
    assert search == ()


def test_graph_without_edges_has_each_vertex_as_a_clique() -> None:
    assert len(maximum_cliques(pack_rows(np.zeros((3, 3), bool)), max_cliques=9, max_nodes=ENOUGH)) == 3


def test_complete_graph_is_one_clique() -> None:
    flags = ~np.eye(500, dtype=bool)
    search = maximum_cliques(pack_rows(flags), max_cliques=4, max_nodes=ENOUGH)
    assert [len(clique) for clique in search] == [500]


def test_no_more_cliques_are_returned_than_requested() -> None:
    flags = ~np.eye(8, dtype=bool)
    flags[0, 1] = flags[1, 0] = flags[2, 3] = flags[3, 2] = False
    assert len(maximum_cliques(pack_rows(flags), max_cliques=3, max_nodes=ENOUGH)) == 3
    assert len(maximum_cliques(pack_rows(flags), max_cliques=9, max_nodes=ENOUGH)) == 4


@pytest.mark.parametrize("max_nodes", [1, 10, 1000])
def test_a_limited_search_gives_a_clique(max_nodes: int) -> None:
    flags = random_graph(np.random.default_rng(1), 300, 0.7)
    for max_cliques in (1, 5):
        search = maximum_cliques(pack_rows(flags), max_cliques=max_cliques, max_nodes=max_nodes)
        assert len(search) >= 1
        for clique in search:
            assert flags[np.ix_(clique, clique)].sum() == len(clique) * (len(clique) - 1)


def test_same_graph_gives_the_same_cliques_in_the_same_order() -> None:
    flags = random_graph(np.random.default_rng(2), 120, 0.4)
    first, second = (maximum_cliques(pack_rows(flags), max_cliques=20, max_nodes=ENOUGH) for _ in range(2))
    assert [clique.tolist() for clique in first] == [clique.tolist() for clique in second]


@pytest.mark.data
@pytest.mark.parametrize(("pair", "size"), [("000000_000030", 12), ("000000_004413", 30)])
def test_clique_of_a_real_graph_has_the_size_that_the_authors_program_found(
    data_dir: Path, pair: str, size: int
) -> None:
    golden = np.load(data_dir / "golden" / f"{pair}_fixed_trunkDCVC.npz")
    count = len(golden["corr_src"])
    flags = np.zeros((count, count), bool)
    flags[tuple(golden["edges"].T)] = True
    flags |= flags.T
    search = maximum_cliques(pack_rows(flags), max_cliques=50, max_nodes=ENOUGH)
    assert len(search[0]) == size
    assert tuple(np.sort(golden["clique"]).tolist()) in as_set(search)


def test_a_clique_that_grows_from_a_vertex_contains_it() -> None:
    joined = np.zeros((70, 70), bool)
    joined[np.ix_([3, 20, 66], [3, 20, 66])] = True
    joined[3, 40] = joined[40, 3] = True
    assert sorted(_greedy_clique(pack_rows(joined), 3).tolist()) == [3, 20, 66]
