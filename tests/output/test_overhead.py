"""Ceilings over the path are cut from pictures, and nothing below the open sky."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.rooms import HALF_M, SENSOR_M, placed_keyframes
from matplotlib.image import imread

from segslam import open_dataset
from segslam.core import geometry, processes
from segslam.core.config import MapConfig
from segslam.core.types import GraphEstimate, Keyframe, Label, Transform
from segslam.labels.encodings import COLORS
from segslam.output.map.before_after import BeforeAfter, _whole_steps
from segslam.output.map.from_above import BESIDE_M, LEAST_PX, LOWEST_M, cut_heights, free_heights, visible
from segslam.output.map.picture import MARGIN_M
from segslam.output.map.write import write_map

CEILING_M = 2.6 - SENSOR_M
PATH = np.column_stack([np.arange(0.0, 60.0, 2.0), np.zeros(30), np.zeros(30)])


def _slab(height_m: float, first_m: float = -5.0, last_m: float = 65.0) -> np.ndarray:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(first_m, last_m, 0.2), np.arange(-5.0, 5.0, 0.2)))
    return np.column_stack([x, y, np.full(len(x), height_m)])


def _cut(clouds: list[np.ndarray]) -> np.ndarray:
    return cut_heights(PATH, free_heights(PATH, clouds))


def _roofed() -> list[tuple[Keyframe, Transform]]:
    """The yard below a ceiling."""
    along = np.arange(-HALF_M, HALF_M, 0.15)
    x, y = (axis.ravel() for axis in np.meshgrid(along, along))
    ceiling = np.column_stack([x, y, np.full(len(x), CEILING_M)])
    roofed = []
    for keyframe, T in placed_keyframes(None):
        seen = geometry.apply(geometry.inverse(T), ceiling).astype(np.float32)
        labels = np.append(keyframe.labels, np.full(len(seen), Label.BUILDING, np.uint8))
        roofed.append((replace(keyframe, points=np.concatenate([keyframe.points, seen]), labels=labels), T))
    return roofed


def test_the_cut_is_half_way_up_to_the_ceiling_and_the_floor_stays_visible() -> None:
    cut_m = _cut([_slab(-1.5), _slab(1.0)])
    np.testing.assert_allclose(cut_m, 0.5)
    assert visible(_slab(-1.5), PATH, cut_m).all()
    assert not visible(_slab(1.0), PATH, cut_m).any()


def test_where_the_sky_is_open_nothing_is_cut() -> None:
    trees = [_slab(3.0, x - 1.0, x + 1.0) for x in (10.0, 30.0, 50.0)]
    mount = [_slab(0.4)]
    cut_m = _cut([_slab(-1.5), *trees, *mount])
    assert np.isinf(cut_m).all()
    assert visible(_slab(9.0), PATH, cut_m).all()


def test_a_building_on_the_way_is_cut_and_the_street_is_not() -> None:
    cut_m = _cut([_slab(2.0, 20.0, 65.0)])
    assert np.isinf(cut_m[:8]).all()
    np.testing.assert_allclose(cut_m[12:], 1.0)


def test_heights_over_the_path_are_those_of_a_search_among_all_points() -> None:
    """Also of points that are so far away that their cells are numbered as those of the path."""
    rng = np.random.default_rng(0)
    path_m = rng.uniform(-300.0, 300.0, (300, 3)) * np.array([1.0, 1.0, 0.0])
    beside_path = path_m[:100] + rng.normal(0.0, 0.4, (100, 3)) * np.array([1.0, 1.0, 5.0])
    parts = [beside_path, path_m[100:] + np.array([0.0, 0.0, 2.0]), rng.uniform(-600.0, 600.0, (9999, 3))]
    cloud = np.vstack([*parts, np.vstack(parts) + np.array([256.0, -512.0, -1.0])])
    away_m = np.linalg.norm(cloud[:, None, :2] - path_m[:, :2], axis=2)
    nearest = away_m.argmin(axis=1)
    over = (away_m.min(axis=1) < BESIDE_M) & (cloud[:, 2] > LOWEST_M)
    expected = np.full(len(path_m), np.inf)
    np.minimum.at(expected, nearest[over], cloud[over, 2])
    assert 200 < np.isfinite(expected).sum() < 300
    np.testing.assert_array_equal(free_heights(path_m, [cloud]), expected)


@pytest.mark.parametrize("step", [0.1, 0.25, 1 / 3])
def test_pixels_at_the_border_of_two_are_those_of_a_floor_division(step: float) -> None:
    borders = np.concatenate([np.arange(-5000, 5000) * step, np.arange(-5000, 5000) / 40])
    values = np.concatenate([borders, np.nextafter(borders, -np.inf), np.nextafter(borders, np.inf)])
    np.testing.assert_array_equal(_whole_steps(values, step), (values // step).astype(int))
    assert step == 0.25 or (np.floor(values / step) != values // step).any()


@pytest.mark.long
def test_both_pictures_show_the_floor_below_a_ceiling(tmp_path: Path) -> None:
    write_map(_roofed(), [tmp_path / "map.png"], config=MapConfig())
    picture = np.rint(255 * imread(tmp_path / "map.png")[:, :, :3]).astype(int)
    middle, px_per_m = LEAST_PX / 2, LEAST_PX / (2 * (HALF_M + MARGIN_M))
    floor = picture[round(middle - 8.0 * px_per_m), round(middle + 8.0 * px_per_m)]
    road = np.array(list(bytes.fromhex(COLORS[Label.ROAD][1:])))
    assert np.abs(floor - road).max() <= 3
    drawn = []
    for yard in (_roofed(), placed_keyframes(None)):
        (tmp_path / "both.png").write_bytes(_before_after(yard).draw())
        drawn.append((imread(tmp_path / "both.png")[40:, :, :3].mean(axis=2) > 0.3).mean())
    assert drawn[0] < drawn[1] + 0.01  # without the cut, the ceiling would fill the yard


@pytest.mark.data
@pytest.mark.parametrize(("name", "frames", "share"), [("courtyard", "0:100:5", 1.0), ("nclt", "0:150", 0.0)])
def test_a_roofed_courtyard_is_cut_everywhere_and_a_campus_nowhere(
    data_dir: Path, name: str, frames: str, share: float
) -> None:
    rows = np.loadtxt(data_dir / name / "poses.txt").reshape(-1, 3, 4)
    poses = [geometry.transform(row[:, :3], row[:, 3]) for row in rows]
    scans = open_dataset(data_dir / name, labels="none", frames=frames)
    placed = [geometry.apply(poses[int(scan.index or 0)], scan.points.astype(float)) for scan in scans]
    path_m = np.array([poses[int(scan.index or 0)][:3, 3] for scan in scans])
    assert np.isfinite(cut_heights(path_m, free_heights(path_m, placed))).mean() == share


def test_the_clouds_of_a_loop_are_shown_without_the_ceiling() -> None:
    roofed = _roofed()
    drawn = _before_after(roofed)
    for keyframe, _ in roofed:
        points, labels = drawn.below_ceiling(keyframe.id)
        assert points[:, 2].max() < CEILING_M
        assert len(points) == len(labels) > 0


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="one process elsewhere")
def test_pictures_have_the_same_bytes_with_any_number_of_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = set[bytes]()
    for number in (1, 2, 4):
        monkeypatch.setattr(processes, "_num_processes", lambda number=number: number)
        drawn.add(_before_after(_roofed()).draw())
    assert len(drawn) == 1


def _before_after(yard: list[tuple[Keyframe, Transform]]) -> BeforeAfter:
    poses = {keyframe.id: T for keyframe, T in yard}
    clouds = {keyframe.id: (keyframe.points, keyframe.labels) for keyframe, _ in yard}
    return BeforeAfter(poses, GraphEstimate(poses, 0.0, {}), list(clouds), clouds.__getitem__)
