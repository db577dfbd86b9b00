"""The vertical angle on the command line: measured, applied on reading, kept with the run."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.commands import run
from helpers.drives import write_kitti_sequence
from helpers.yards import seen

from segslam.core import geometry
from segslam.core.pose_files import write_kitti
from segslam.core.types import Trajectory
from segslam.odometry.sweep import GivenOdometry
from segslam.output.log import read_log
from segslam.slam.adjustment import vertical_angle

PLACES_M = np.arange(-40.0, 41.0, 2.5)
POSES = np.array([geometry.transform(np.eye(3), [x_m, 0.0, 0.0]) for x_m in PLACES_M])


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of scans along a walled yard, whose points lie too low by 0.3 degrees."""
    folder = tmp_path_factory.mktemp("yard")
    for number, x_m in enumerate(PLACES_M):
        points = seen(x_m, low_deg=0.3, seed=number)
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(folder / f"{number:06d}.bin")
    return folder


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> None:
    """The true poses instead of KISS-ICP, which detects no motion between smooth walls."""
    truth = Trajectory(np.arange(len(PLACES_M)), np.arange(len(PLACES_M)) * 10**8, POSES)
    monkeypatch.setattr(vertical_angle, "KissOdometry", lambda config: GivenOdometry(truth, config))


def calibrated(data: Path, capsys: pytest.CaptureFixture[str], *options: str) -> dict:
    assert run("calibrate", data, "--json", "--quiet", *options) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.long
def test_the_angle_is_measured_and_no_error_remains_after_setting_it(
    yard: Path, given: None, capsys: pytest.CaptureFixture[str]
) -> None:
    found = calibrated(yard, capsys)
    assert found["vertical_deg"] == pytest.approx(0.3, abs=0.05)
    assert found["is_significant"]
    assert found["applied_deg"] == 0.0
    again = calibrated(yard, capsys, "--set", f"sensor.vertical_angle_deg={found['set_deg']}")
    assert again["vertical_deg"] == pytest.approx(0.0, abs=0.05)
    assert not again["is_significant"]
    assert again["set_deg"] == pytest.approx(found["set_deg"], abs=0.05)


@pytest.mark.slow
def test_a_run_reports_the_angle_with_the_setting_that_corrects_it(
    yard: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_kitti(tmp_path / "given.txt", POSES)
    options = ["--odometry", tmp_path / "given.txt", "--labels", "none", "--set", "adjustment.max_minutes=0"]
    assert run("map", yard, "--out", tmp_path / "run", *options) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["vertical_deg"] == pytest.approx(0.3, abs=0.06)
    expected = f"beams point {metrics['vertical_deg']:.2f} +- {metrics['vertical_sigma_deg']:.2f} degrees low; "
    expected += f"map again with --set sensor.vertical_angle_deg={metrics['vertical_deg']:.2f}"
    assert expected in capsys.readouterr().err
    assert expected in (tmp_path / "run" / "report.html").read_text()


def test_a_drive_too_short_for_the_angle_gives_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_kitti_sequence(tmp_path, num_scans=6)
    found = calibrated(tmp_path, capsys)
    assert (found["vertical_deg"], found["sigma_deg"], found["num_pairs"]) == (None, None, 0)
    assert found["applied_deg"] == 0.205
    assert run("calibrate", tmp_path) == 0
    assert "the vertical angle cannot be measured" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.usefixtures("short_runs")
@pytest.mark.parametrize(("options", "kept_deg"), [([], 0.205), (["--set", "sensor.vertical_angle_deg=0"], 0.0)])
def test_a_run_keeps_the_angle_that_its_scans_were_read_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], kept_deg: float
) -> None:
    write_kitti_sequence(tmp_path / "kitti", num_scans=4)
    out = tmp_path / "run"
    assert run("map", tmp_path / "kitti", "--out", out, "--quiet", "--frames", "0:3", *options) == 0
    settings = yaml.safe_load((out / "config.yaml").read_text())
    assert settings["sensor"]["vertical_angle_deg"] == kept_deg
    assert read_log(out / "log.mcap").config.sensor.vertical_angle_deg == kept_deg
    assert "vertical_deg" not in json.loads((out / "metrics.json").read_text()), "three scans do not show it"
    changed = ["--set", "sensor.vertical_angle_deg=0.1"]
    assert run("replay", out / "log.mcap", "--out", tmp_path / "again", *changed) == 2
    assert "sensor.vertical_angle_deg: " in capsys.readouterr().err
    assert run("map", tmp_path / "kitti", "--out", out, "--resume", "--frames", "0:3", "--quiet", *changed) == 2
    assert "sensor.vertical_angle_deg: " in capsys.readouterr().err
