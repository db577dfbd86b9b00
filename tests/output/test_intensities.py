"""Intensities from each kind of data, through a run and its log, to the map; a point's is made of its range."""

from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest
from helpers.commands import run
from helpers.drives import intensities, write_kitti_sequence
from helpers.finished_run import make_run
from helpers.recorded_drive import TOPIC, write_bag1, write_mcap

from segslam.core.types import Scan
from segslam.output.log import read_log
from segslam.scans import open_dataset

pytestmark = pytest.mark.usefixtures("short_runs")

BY_INTENSITY = ("--set", "map.color=intensity")


def _assert_known(scan: Scan, *, rtol: float = 1e-5) -> None:
    assert scan.intensities is not None
    assert scan.intensities.dtype == np.float32
    np.testing.assert_allclose(scan.intensities, intensities(scan.points.astype(float)), rtol=rtol)


def test_kitti_scans_have_them_if_requested(tmp_path: Path) -> None:
    write_kitti_sequence(tmp_path, num_scans=1)
    _assert_known(open_dataset(tmp_path, intensities=True)[0])
    assert open_dataset(tmp_path)[0].intensities is None


@pytest.mark.parametrize("write", [write_mcap, write_bag1])
def test_recordings_have_them_without_what_returned_nothing(write, tmp_path: Path) -> None:
    scans = open_dataset(
        write(tmp_path / f"drive.{'mcap' if write is write_mcap else 'bag'}"), topic=TOPIC, intensities=True
    )
    for row in (0, 3):
        _assert_known(scans[row])


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
@pytest.mark.parametrize(
    ("field", "kind", "scale"), [("intensity", np.float32, 1.0), ("reflectivity", np.uint16, 1000.0)]
)
def test_files_of_clouds_have_them_by_any_of_their_names(
    tmp_path: Path, suffix: str, field: str, kind: type, scale: float
) -> None:
    points = np.random.default_rng(0).uniform(5, 60, (400, 3)).astype(np.float32)
    cloud = o3d.t.geometry.PointCloud(points)
    cloud.point[field] = o3d.core.Tensor((scale * intensities(points)).astype(kind)[:, None])
    o3d.t.io.write_point_cloud(str(tmp_path / f"0.{suffix}"), cloud)
    scan = open_dataset(tmp_path, intensities=True)[0]
    np.testing.assert_allclose(scan.intensities, scale * intensities(scan.points), rtol=1e-2)  # whole thousandths


def test_clouds_without_any_are_read_all_the_same(tmp_path: Path) -> None:
    o3d.t.io.write_point_cloud(str(tmp_path / "0.ply"), o3d.t.geometry.PointCloud(np.eye(3, dtype=np.float32)))
    assert open_dataset(tmp_path, intensities=True)[0].intensities is None


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose log keeps intensities."""
    root = tmp_path_factory.mktemp("mapped")
    write_kitti_sequence(root, num_scans=3)
    assert run("map", root, "--out", root / "run", *BY_INTENSITY, "--quiet") == 0
    return root / "run"


def test_keyframes_of_the_log_have_those_of_their_points(mapped: Path) -> None:
    for step in read_log(mapped / "log.mcap").steps():
        if step.keyframe is not None:
            known = step.keyframe.intensities
            true = intensities(step.keyframe.points.astype(float))  # points are rounded to 4 mm, KITTI's to the float
            assert np.abs(np.sqrt(known / known.max()) - np.sqrt(true / known.max())).max() < 0.5 / 255 + 5e-4


def test_the_map_has_each_points_intensity_and_its_colour(mapped: Path, tmp_path: Path) -> None:
    """Of one keyframe, in voxels so small that most hold one point: its range, to the step of the log's byte."""
    files = [tmp_path / f"map.{ending}" for ending in ("ply", "pcd", "laz")]
    assert run("export", mapped, *files, "--set", "map.voxel_m=0.02", "--set", "map.view_range_m=0", "--quiet") == 0
    ply, pcd = (o3d.t.io.read_point_cloud(str(file)).point for file in files[:2])
    laz = laspy.read(files[2])
    values, colors = ply.intensity.numpy().ravel(), ply.colors.numpy()
    np.testing.assert_array_equal(values, pcd.intensity.numpy().ravel())
    np.testing.assert_allclose(np.asarray(laz.intensity) / 65535, values / values.max(), atol=0.01)
    assert 0.1 < values.min() * 100 < 5.0 < 40.0 < values.max() * 100 < 51.0  # ranges, up to map.max_range_m
    green = colors[np.argsort(values), 1].astype(int)  # of viridis, from violet to yellow, it only grows
    assert (np.diff(green) >= 0).all()
    assert green[0] < 10 < 220 < green[-1]


def test_colours_of_classes_leave_the_intensities_in_the_cloud(mapped: Path, tmp_path: Path) -> None:
    assert run("export", mapped, tmp_path / "map.ply", "--set", "map.color=class", "--quiet") == 0
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "map.ply")).point
    assert cloud.intensity.numpy().max() > 0.1
    assert np.ptp(cloud.colors.numpy(), axis=1).max() > 0


def test_a_replay_keeps_them(mapped: Path, tmp_path: Path) -> None:
    assert run("replay", mapped / "log.mcap", "--out", tmp_path / "again", "--quiet") == 0
    logs = [read_log(folder / "log.mcap") for folder in (mapped, tmp_path / "again")]
    for step, again in zip(*(log.steps() for log in logs), strict=True):
        if step.keyframe is not None:
            np.testing.assert_array_equal(again.keyframe.intensities, step.keyframe.intensities)


def test_a_log_without_them_is_reported_with_the_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    without = make_run(tmp_path / "run").folder
    assert run("export", without, tmp_path / "map.ply", *BY_INTENSITY, "--quiet") == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert "no intensities; runs contain them only if mapped with `--set map.color=intensity`" in message
    assert not (tmp_path / "map.ply").exists()


def test_data_without_them_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "clouds").mkdir()
    o3d.t.io.write_point_cloud(
        str(tmp_path / "clouds" / "0.ply"), o3d.t.geometry.PointCloud(9 * np.eye(3, dtype=np.float32))
    )
    assert run("map", tmp_path / "clouds", "--out", tmp_path / "run", *BY_INTENSITY, "--json") == 2
    printed = capsys.readouterr()
    assert "map.color=intensity: generic/clouds has no intensities" in printed.err
    assert printed.out == ""
    assert not (tmp_path / "run").exists()
