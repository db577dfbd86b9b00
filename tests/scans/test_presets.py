"""Settings for the kind of place, chosen by how near the surfaces are."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run

from segslam.core.config import Config
from segslam.scans import open_dataset
from segslam.scans.presets import LARGEST_M, extent_m, preset, preset_for


def write_ring(folder: Path, distance_m: float, num_scans: int = 3) -> Path:
    """Scans of a round wall, each with a second ring of many more points at the sensor's feet."""
    azimuth = np.linspace(-np.pi, np.pi, 2000, endpoint=False)
    heights = np.repeat(np.linspace(-1.0, 2.0, 7), len(azimuth))
    wall = np.column_stack([distance_m * np.cos(azimuth), distance_m * np.sin(azimuth)])
    points = np.column_stack([np.tile(wall, (7, 1)), heights])
    feet = np.column_stack([1.2 * np.cos(azimuth), 1.2 * np.sin(azimuth), np.full(len(azimuth), -1.0)])
    cloud = np.column_stack([np.vstack([points, *[feet] * 10]), np.zeros(len(points) + 10 * len(feet))])
    folder.mkdir()
    for index in range(num_scans):
        cloud.astype(np.float32).tofile(folder / f"{index:06d}.bin")
    return folder


@pytest.mark.parametrize("distance_m", [6.0, 15.0, 40.0])
def test_extent_is_the_distance_of_the_surfaces_however_many_points_are_near(tmp_path: Path, distance_m: float) -> None:
    folder = write_ring(tmp_path / "scans", distance_m)
    assert extent_m(open_dataset(folder)) == pytest.approx(distance_m, abs=0.6)


@pytest.mark.parametrize("wild", [1e18, 3.4e38, 1e5])
def test_one_wild_point_does_not_change_the_extent(tmp_path: Path, wild: float) -> None:
    folder = write_ring(tmp_path / "scans", 6.0)
    expected = extent_m(open_dataset(folder))
    with (folder / "000001.bin").open("ab") as stream:
        stream.write(np.array([wild, 3, 1, 0], np.float32).tobytes())
    assert extent_m(open_dataset(folder)) == expected


def test_an_unusable_scan_is_left_out(tmp_path: Path) -> None:
    folder = write_ring(tmp_path / "scans", 6.0, num_scans=1)
    (folder / "000001.bin").write_bytes(b"")
    assert extent_m(open_dataset(folder)) == pytest.approx(6.0, abs=0.6)
    (folder / "000000.bin").write_bytes(b"")
    assert extent_m(open_dataset(folder)) is None


def test_the_preset_follows_the_extent() -> None:
    names = [preset_for(extent) for extent in (LARGEST_M["indoor"], 12.1, LARGEST_M["campus"], 17.1, None)]
    assert names == ["indoor", "campus", "campus", "driving", "driving"]
    assert preset("driving") == Config()
    assert preset("indoor").odometry.max_range_m == 40.0


@pytest.mark.data
def test_real_places_have_the_presets_that_they_were_measured_with(data_dir: Path) -> None:
    for name, expected in (("courtyard", "indoor"), ("nclt", "campus")):
        assert preset_for(extent_m(open_dataset(data_dir / name))) == expected


def test_map_shows_and_keeps_the_preset_and_settings_change_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_ring(tmp_path / "scans", 6.0)
    assert run("map", folder, "--dry-run", "--json", "--set", "keyframes.distance_m=0.7") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["changed_settings"] == {
        "keyframes.distance_m": "0.7",
        "odometry.max_range_m": "40.0",
        "odometry.min_range_m": "0.5",
        "odometry.voxel_size_m": "0.4",
        "proximity.min_travel_m": "20.0",
    }
    assert run("map", folder, "--dry-run", "--preset", "driving") == 0
    assert "--preset" not in capsys.readouterr().err


def test_a_preset_that_does_not_exist_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_ring(tmp_path / "scans", 6.0)
    assert run("map", folder, "--out", tmp_path / "run", "--preset", "forest") == 2
    assert "--preset forest: unknown preset; known: auto, driving, campus, indoor" in capsys.readouterr().err
