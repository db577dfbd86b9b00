"""Voxels, tiles and views of a map, against plain twins."""

import math
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest

from segslam.core.types import Label
from segslam.output.map.grid import lowest_ground
from segslam.output.map.tiles import TILE_M, VOXEL, Histogram, Tiles, corner, distance_m, merged
from segslam.output.map.views import CELL_RAD, NOTHING, NUM_COLUMNS, NUM_ROWS, STEP_M, count_votes, nearest_returns

VOXEL_M = 0.5


def _random_voxels(rng: np.random.Generator, num: int = 400) -> np.ndarray:
    voxels = np.zeros(num, VOXEL)
    voxels["point"] = rng.uniform((0, 0, -2), (3, 3, 2), (num, 3))
    voxels["count"], voxels["label"] = rng.integers(1, 5, num), rng.integers(0, 4, num)
    voxels["intensity"] = rng.uniform(0, 255, num)
    return voxels


def test_voxels_are_weighted_means_with_the_commonest_label() -> None:
    voxels = _random_voxels(np.random.default_rng(0))
    cells = defaultdict(list)
    for voxel in voxels:
        cells[tuple(np.floor(voxel["point"] / VOXEL_M).astype(int))].append(voxel)
    result = merged(voxels, VOXEL_M)
    assert len(result) == len(cells)
    for voxel in result:
        members = cells[tuple(np.floor(voxel["point"] / VOXEL_M).astype(int))]
        counts = [int(member["count"]) for member in members]
        labels = Counter[int]()
        for member in members:
            labels[int(member["label"])] += int(member["count"])
        most = max(labels.values())
        assert voxel["count"] == sum(counts)
        assert voxel["label"] == min(label for label, count in labels.items() if count == most)
        np.testing.assert_allclose(
            voxel["point"], np.average([m["point"] for m in members], axis=0, weights=counts), atol=1e-5
        )
        mean = np.average([m["intensity"] for m in members], weights=counts)
        assert voxel["intensity"] == pytest.approx(mean, rel=1e-6)  # float32


def test_voxels_of_pieces_are_those_of_the_whole() -> None:
    voxels = _random_voxels(np.random.default_rng(1))
    voxels["label"] = 3  # labels of pieces that are outvoted in each are lost
    halves = np.concatenate([merged(voxels[:200], VOXEL_M), merged(voxels[200:], VOXEL_M)])
    a, b = (v[np.lexsort(np.floor(v["point"] / VOXEL_M).T)] for v in (merged(voxels, VOXEL_M), merged(halves, VOXEL_M)))
    assert a["count"].tolist() == b["count"].tolist()
    np.testing.assert_allclose(a["point"], b["point"], atol=1e-6)
    np.testing.assert_allclose(a["intensity"], b["intensity"], rtol=1e-6)


def test_tiles_give_back_what_was_added_wherever_it_lies(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform((-70, -70, -5), (70, 70, 5), (3000, 3))
    tiles = Tiles(tmp_path / "tiles", voxel_m=0.01)  # so small that each point has its own
    for part in np.array_split(points, 7):
        tiles.add(part, np.full(len(part), Label.POLE, np.uint8), np.zeros(len(part)))
        tiles.flush()
    found = np.concatenate([tiles.voxels(tile)["point"] + corner(tile) for tile in tiles])
    np.testing.assert_allclose(_sorted(found), _sorted(points), atol=1e-5)
    rows = [tile[1] for tile in tiles]
    assert rows == sorted(rows, reverse=True)


def test_the_span_of_a_stream_is_that_of_its_shares_to_an_edge() -> None:
    values = np.random.default_rng(4).permutation(np.arange(1000.0))
    counted = Histogram(np.arange(0.0, 1001.0, 50.0))
    for some in np.array_split(values, 6):
        counted.add(some)
    assert counted.span(0.12, 0.88) == (100.0, 900.0)  # 120 and 880, to the edges below and above
    counted.add(np.array([-5.0, 2e6]))
    assert counted.span(0.0, 1.0) == (0.0, 1000.0)


def test_a_places_distance_to_a_tile_is_nought_within_and_to_its_border_outside() -> None:
    assert distance_m((0, 0), np.array([5.0, 5.0, 9.0])) == 0.0
    assert distance_m((0, 0), np.array([-3.0, 5.0, 0.0])) == 3.0
    assert distance_m((-1, -1), np.array([3.0, 4.0, 0.0])) == 5.0
    assert distance_m((1, 0), np.array([TILE_M - 2.0, 1.0, 0.0])) == 2.0


def test_views_and_votes_are_those_of_plain_loops() -> None:
    rng = np.random.default_rng(3)
    scan = rng.uniform(-20, 20, (300, 3)).astype(np.float32)
    asked = (rng.uniform(0.6, 1.3, (300, 1)) * scan).astype(np.float32)  # before, at and behind what was seen
    view, nearest = nearest_returns(scan, 0.4), _plain_view(scan, 0.4)
    np.testing.assert_array_equal(view, nearest)
    votes = np.zeros((300, 2), np.uint32)
    count_votes(asked, np.eye(4), view, np.array([22.0, 0.5, 0.02]), votes)
    plain = np.array([_plain_vote(point.astype(float), nearest) for point in asked])
    np.testing.assert_array_equal(votes, plain)
    assert votes.sum(axis=0).min() > 5


def test_ground_is_the_lowest_in_the_cell_or_in_the_nearest_with_ground() -> None:
    ground = np.array([[1.0, 1.0, -1.0], [1.5, 0.5, -2.0], [31.0, 31.0, 5.0]])
    asked = np.array([[0.2, 0.2, 0.0], [4.0, 4.0, 0.0], [30.1, 31.9, 9.0], [25.0, 28.0, 0.0]])
    np.testing.assert_array_equal(lowest_ground(asked, ground, 32.0), [-2.0, -2.0, 5.0, 5.0])


def _sorted(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(np.round(points, 3).T)]


def _plain_cell(point: np.ndarray) -> tuple[float, float]:
    row = math.atan2(point[2], math.hypot(point[0], point[1])) / CELL_RAD + NUM_ROWS / 2
    return row, (math.atan2(point[1], point[0]) + math.pi) / CELL_RAD


def _plain_view(scan: np.ndarray, spread_m: float) -> np.ndarray:
    nearest = np.full((NUM_ROWS, NUM_COLUMNS), NOTHING, np.uint16)
    for point in scan.astype(float):
        distance = math.sqrt(point @ point)
        if distance < 1.0:
            continue
        row, column = _plain_cell(point)
        spread = min(max(spread_m / distance / CELL_RAD, 0.5), 12)
        for i in range(NUM_ROWS):
            if math.trunc(row - spread) <= i <= math.trunc(row + spread):
                for j in range(math.floor(column - spread), math.floor(column + spread) + 1):
                    nearest[i, j % NUM_COLUMNS] = min(nearest[i, j % NUM_COLUMNS], int(distance / STEP_M))
    return nearest


def _plain_vote(point: np.ndarray, nearest: np.ndarray) -> tuple[int, int]:
    distance = math.sqrt(point @ point)
    row, column = _plain_cell(point)
    if distance > 22.0 or not 0 <= row < NUM_ROWS or distance < 1.0:
        return 0, 0
    seen, margin = nearest[int(row), int(column) % NUM_COLUMNS], 0.5 + 0.02 * distance
    if seen == NOTHING or seen * STEP_M <= distance - margin:
        return 0, 0
    return (0, 1) if seen * STEP_M > distance + margin else (1, 0)
