"""`segslam export` and `segslam map --map`: what is written where, and what is refused."""

import json
from pathlib import Path

import open3d as o3d
import pytest
from helpers.commands import run
from helpers.drives import write_kitti_sequence
from helpers.finished_run import make_run
from matplotlib.image import imread

from segslam.core.types import WorkFailed

pytestmark = pytest.mark.usefixtures("short_runs")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("made") / "run").folder


def test_export_writes_each_kind_by_its_ending(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / name for name in ("a.ply", "b.pcd", "c.png", "d.yaml")]
    assert run("export", finished, *files, "--json", "--quiet") == 0
    figures = json.loads(capsys.readouterr().out)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.ply", "b.pcd", "c.png", "d.pgm", "d.yaml"]
    assert len(o3d.io.read_point_cloud(str(files[0])).points) == figures["num_map_points"] > 0


@pytest.mark.long
def test_export_draws_the_map_before_and_after_loop_closing(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("export", finished, tmp_path / "before_after.png") == 0
    assert f"map in {tmp_path / 'before_after.png'}" in capsys.readouterr().err
    assert imread(tmp_path / "before_after.png").shape[1] == 1200
    assert (
        run("export", finished, tmp_path / "before_after.png", tmp_path / "map.ply", "--json", "--quiet", "--overwrite")
        == 0
    )
    assert json.loads(capsys.readouterr().out)["num_map_points"] > 0


def test_export_prints_the_number_of_removed_points(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("export", finished, tmp_path / "map.ply") == 0
    output = capsys.readouterr().err
    assert "0 points by class" in output
    assert f"map in {tmp_path / 'map.ply'}" in output


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["map.stl"], "map.stl: unknown kind of map; its name must end in .ply, .pcd, .las, .laz, .png, .yaml"),
        (["map.stl"], ".tif, .tiff, .geojson, .kml, .gpx"),
        (["no/such/map.ply"], "there is no folder"),
        (["map.ply", "--set", "map.colour=height"], "unknown key map.colour; known keys: voxel_m,"),
        (["map.ply", "--set", "map.voxel_m=0"], "map.voxel_m: Input should be greater than or equal to 0.02, got 0"),
    ],
)
def test_export_refuses_with_one_line(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], output: str
) -> None:
    status = run("export", finished, tmp_path / arguments[0], *arguments[1:])
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert status == 2
    assert message.startswith("segslam: ")
    assert output in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("files", "output"),
    [
        (["before_after.png", "no/such/map.ply"], "there is no folder"),
        (["before_after.png", "map.stl"], "unknown kind of map"),
        (["map.ply", "no/before_after.png"], "there is no folder"),
        (["map.ply", "map.ply"], "map.ply: given twice"),
        (["before_after.png", "map.ply", "grid.yaml"], "grid.pgm: exists and is not a regular file"),
    ],
)
def test_an_export_that_fails_writes_none_of_its_files(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], files: list[str], output: str
) -> None:
    if "grid.yaml" in files:
        (tmp_path / "grid.pgm").mkdir()
    assert run("export", finished, *(tmp_path / name for name in files), "--quiet") == 2
    assert output in capsys.readouterr().err
    assert [file for file in tmp_path.iterdir() if file.is_file()] == []


def test_an_unfinished_run_has_no_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = make_run(tmp_path / "cut", finished=False).folder
    assert run("export", cut, tmp_path / "map.ply") == 2
    assert "did not finish; continue it (segslam resume), or replay its log" in capsys.readouterr().err


@pytest.mark.long
def test_map_writes_the_map_with_the_run_and_adds_missing_maps_to_a_finished_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kitti = tmp_path / "kitti"
    write_kitti_sequence(kitti, num_scans=4)
    out = tmp_path / "run"
    assert run("map", kitti, "--out", out, "--map", "--json", "--quiet") == 0
    metrics = json.loads(capsys.readouterr().out)
    assert len(o3d.io.read_point_cloud(str(out / "map.ply")).points) == metrics["num_map_points"] > 1000
    assert (out / "map.png").is_file()
    assert run("map", kitti, "--out", out, "--map-file", "grid.yaml", "--resume", "--quiet") == 0
    assert (out / "grid.pgm").is_file()


def test_a_map_that_cannot_be_made_does_not_affect_other_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*_: object, **__: object) -> None:
        raise WorkFailed("no room")

    kitti, out = tmp_path / "kitti", tmp_path / "run"
    write_kitti_sequence(kitti, num_scans=3)
    with monkeypatch.context() as broken:
        broken.setattr("segslam.output.export.write_maps", no_room)
        assert run("map", kitti, "--out", out, "--map", "--quiet") != 0
    assert json.loads((out / "metrics.json").read_text())["num_scans"] == 3
    assert (out / "report.html").is_file()
    assert run("map", kitti, "--out", out, "--map", "--resume", "--quiet") == 0
    assert (out / "map.ply").is_file()
