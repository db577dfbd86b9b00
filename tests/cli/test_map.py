import json
import multiprocessing
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import round_drive, write_kitti_sequence

from segslam import map_folder
from segslam.core.config import OdometryConfig
from segslam.core.errors import SegslamError
from segslam.core.pose_files import read_poses, write_kitti
from segslam.core.trajectory import travelled_m
from segslam.output.log import read_log

RUN_FILES = {
    "config.yaml",
    "graph.g2o",
    "log.mcap",
    "loops.csv",
    "metrics.json",
    "odometry_kitti.txt",
    "odometry_tum.txt",
    "poses_kitti.txt",
    "poses_tum.txt",
    "report.html",
}


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten scans in KITTI's format, the fifth truncated."""
    root = tmp_path_factory.mktemp("kitti")
    broken = write_kitti_sequence(root, num_scans=10) / "000004.bin"
    broken.write_bytes(broken.read_bytes()[:-5])
    return root


def test_map_writes_a_whole_run_and_skips_the_bad_scan(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert run("map", kitti, "--out", out, "--json", "--quiet") == 0
    printed = capsys.readouterr()
    metrics = json.loads(printed.out)
    assert metrics == json.loads((out / "metrics.json").read_text())
    assert {file.name for file in out.iterdir()} >= RUN_FILES
    assert (metrics["num_scans"], metrics["num_scans_skipped"]) == (9, 1)
    assert len(read_poses(out / "poses_kitti.txt")) == 9
    assert len(list(read_log(out / "log.mcap").steps())) == 9
    assert {"ate_m", "odometry_ate_m", "rpe_m", "stage_ms", "peak_rss_mb"} <= set(metrics)
    assert metrics["num_motions_broken"] == 0, "a missing scan breaks nothing"
    truth = round_drive()[1].T_world_lidar[[0, 1, 2, 3, 5, 6, 7, 8, 9]]
    assert metrics["length_m"] == pytest.approx(travelled_m(truth)[-1], rel=0.05)
    assert metrics["duration_s"] == pytest.approx(2.7)


@pytest.mark.long
def test_the_end_of_map_leads_on(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Length and duration, the error by stage, the report, the next command; also of a replay."""
    out = tmp_path / "my run"
    assert run("map", kitti, "--out", out, "--map-file", "grid.yaml") == 0
    shown = capsys.readouterr().err
    assert shown.splitlines()[-1].startswith("next: "), "below the lines about the map"
    metrics = json.loads((out / "metrics.json").read_text())
    for text in (
        f"drive: {metrics['length_m']:.0f} m in 3 s",
        f"error after alignment: {metrics['ate_m']:.3f} m, odometry",
        f"the same error of KISS-ICP alone: {metrics['kiss_icp_ate_m']:.3f} m",
        f"report: {out / 'report.html'}",
        f"next: segslam export '{out}' ",
    ):
        assert text in shown
    assert len(read_poses(out / "kiss_icp_tum.txt")) == metrics["num_scans"]
    assert run("replay", out, "--out", tmp_path / "again", "--json", "--quiet") == 0
    assert json.loads(capsys.readouterr().out)["kiss_icp_ate_m"] == pytest.approx(metrics["kiss_icp_ate_m"])


@pytest.mark.parametrize("mapped", [lambda data, out: run("map", data, "--out", out), map_folder])
def test_kiss_icp_alone_is_computed_only_to_be_compared_with_the_truth(
    mapped: Callable[[Path, Path], object], tmp_path: Path
) -> None:
    write_kitti_sequence(tmp_path / "kitti", num_scans=5)
    shutil.rmtree(tmp_path / "kitti" / "poses")
    mapped(tmp_path / "kitti", tmp_path / "run")
    assert len(read_poses(tmp_path / "run" / "odometry_tum.txt")) == 5
    assert not list((tmp_path / "run").glob("kiss_icp_*"))


def test_a_run_folder_is_never_overwritten(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.txt").write_text("results")
    assert run("map", kitti, "--out", tmp_path) == 2
    advice = "not empty; give another folder with --out, or replace results of this command: --overwrite"
    assert advice in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_run_that_cannot_start_leaves_no_process(
    kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        assert multiprocessing.active_children(), "the odometry has started"
        raise SegslamError("no room")

    monkeypatch.setattr("segslam.run.map_folder.Run", refuse)
    assert run("map", kitti, "--out", tmp_path / "run") == 2
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--set", "keyframes.distance=1"], "keyframes.distance"),
        (["--sequence", "07"], "07"),
        (["--frames", "50:60"], "--frames 50:60"),
        (["--labels", "nowhere"], "nowhere"),
        (["--odometry", "missing.txt"], "missing.txt"),
        (["--config", "missing.yaml"], "missing.yaml"),
        (["--dataset", "kitty"], "kitty"),
    ],
)
def test_bad_usage_is_reported_in_one_line_and_nothing_is_written(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], expected: str
) -> None:
    out = tmp_path / "run"
    assert run("map", kitti, "--out", out, *options) == 2
    message = capsys.readouterr().err.strip()
    assert expected in message
    assert len(message.splitlines()) == 1
    assert not out.exists()


def test_a_given_odometry_is_cropped_by_the_ranges_of_the_preset(
    kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ranges_m: list[float] = []

    def given(file: Path, scans: object, config: OdometryConfig) -> None:
        ranges_m.append(config.max_range_m)
        raise SegslamError("far enough")

    monkeypatch.setattr("segslam.run.map_folder.given_odometry", given)
    words = ("--odometry", "poses.txt", "--preset", "indoor")
    assert run("map", kitti, "--out", tmp_path / "run", *words) == 2
    assert ranges_m == [40.0]


@pytest.mark.long
def test_a_given_odometry_is_used_unchanged(kitti: Path, tmp_path: Path) -> None:
    given = tmp_path / "given.txt"
    write_kitti(given, round_drive()[1].T_world_lidar)
    words = ("--odometry", given, "--set", "adjustment.max_minutes=0", "--quiet")
    assert run("map", kitti, "--out", tmp_path / "run", *words) == 0
    poses = read_poses(tmp_path / "run" / "odometry_tum.txt").T_a_b
    truth = round_drive()[1].T_world_lidar
    expected = np.linalg.inv(truth[0]) @ truth[[0, 1, 2, 3, 5, 6, 7, 8, 9]]
    np.testing.assert_allclose(poses, expected, atol=1e-6)
