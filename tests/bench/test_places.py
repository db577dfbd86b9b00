"""`bench places`: recall of recognised places."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run

from segslam.bench.experiments.places import measure, parse_range, read_places
from segslam.core.types import SegslamError


def write_places(file: Path, num: int = 8) -> Path:
    """Every place twice, 1 m apart, and 100 m from the next; the second visit turned by half a turn."""
    rng = np.random.default_rng(0)
    first = np.where(rng.random((num, 151, 151)) < 0.05, 77, 0).astype(np.uint8)
    poses = np.tile(np.eye(4)[:3], (2 * num, 1, 1))
    poses[:, 0, 3] = np.r_[np.arange(num), np.arange(num) + 0.01] * 100.0
    np.savez(file, columns=np.concatenate([first, first[:, ::-1, ::-1]]), poses=poses)
    return file


@pytest.mark.parametrize("turned_seed", [None, 0])
def test_places_seen_again_are_recognised(tmp_path: Path, turned_seed: int | None) -> None:
    places = read_places(write_places(tmp_path / "places.npz"))
    figures = measure(places, range(8), range(8, 16), turned_seed=turned_seed)
    assert figures["num_queries"] == 8
    assert figures["recall_at_1"] == 1.0
    assert figures["index_bytes"] <= 3000


def test_queries_without_a_place_do_not_count(tmp_path: Path) -> None:
    places = read_places(write_places(tmp_path / "places.npz"))
    assert measure(places, range(4), range(8, 16))["num_queries"] == 4
    with pytest.raises(SegslamError, match="no query"):
        measure(places, range(4), range(12, 16))


def test_columns_become_a_point_a_voxel(tmp_path: Path) -> None:
    places = read_places(write_places(tmp_path / "places.npz"))
    row, column = np.argwhere(places.columns[0])[0]
    points = places.points(0)
    there = points[np.hypot(points[:, 0] - (75 - row) * 0.4, points[:, 1] - (75 - column) * 0.4) < 1e-9]
    np.testing.assert_allclose(there[:, 2], [0.0, 0.4, 0.8])  # 77 of 255 are three voxels of ten


@pytest.mark.parametrize("text", ["", "3", "5:2", "0:99", "a:b", "-3:4"])
def test_a_range_that_is_none_is_refused_with_its_option(text: str) -> None:
    with pytest.raises(SegslamError, match=r"--queries .*A:B"):
        parse_range(text, "--queries", 16)
    assert parse_range("3:", "--queries", 16) == range(3, 16)


def test_a_file_without_places_is_refused_by_name(tmp_path: Path) -> None:
    file = tmp_path / "other.npz"
    np.savez(file, columns=np.zeros((2, 3, 4), np.uint8), poses=np.zeros((2, 3, 4)))
    with pytest.raises(SegslamError, match=r"other\.npz: columns"):
        read_places(file)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(SegslamError, match=r"one\.npy: cannot read"):
        read_places(tmp_path / "one.npy")
    file.write_bytes(b"no places")
    with pytest.raises(SegslamError, match=r"other\.npz: cannot read the places \(it is not a \.npz file\)"):
        read_places(file)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "database", "queries", "least"),
    [("kitti_05", range(1000), range(1200, 2761), 0.985), ("kitti_00", range(3000), range(3200, 4541), 0.985)],
)
@pytest.mark.parametrize("turned_seed", [None, 0])
def test_real_places_are_recognised_as_measured(
    data_dir: Path, name: str, database: range, queries: range, least: float, turned_seed: int | None
) -> None:
    figures = measure(read_places(data_dir / "places" / f"{name}.npz"), database, queries, turned_seed=turned_seed)
    assert figures["recall_at_1"] >= least  # 0.993 to 0.999
    assert figures["recall_at_20"] >= 0.995


def test_the_command_prints_the_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_places(tmp_path / "places.npz")
    assert run("bench", "places", file, "--database", "0:8", "--queries", "8:", "--json", "-q") == 0
    figures = json.loads(capsys.readouterr().out)
    assert {"recall_at_1", "recall_at_20", "query_ms", "index_bytes"} <= set(figures)
    assert figures["recall_at_20"] == 1.0
    assert run("bench", "places", file, "--database", "0:8", "--queries", "8:", "--turned") == 0
    assert "recall@1 1.000" in capsys.readouterr().err
    assert run("bench", "places", file, "--database", "0:80", "--queries", "8:") == 2
