"""`segslam resume` and `map --dry-run` on the command line: data and options are read from the log."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import write_kitti_sequence
from helpers.finished_run import make_run

from segslam.cli.checks import is_finished
from segslam.core.config import Config, load_config
from segslam.core.types import BadScan, Scan
from segslam.output.log import LogWriter, read_log
from segslam.scans import Dataset

pytestmark = pytest.mark.usefixtures("short_runs")

OPTIONS = ("--frames", "1:7", "--labels", "true_labels", "--set", "keyframes.distance_m=4", "--map-file", "top.png")


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight scans in KITTI's format."""
    root = tmp_path_factory.mktemp("kitti")
    write_kitti_sequence(root, num_scans=8)
    return root


@pytest.fixture(scope="module")
def whole(kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    assert run("map", kitti, "--out", out, *OPTIONS, "--quiet") == 0
    return out


@pytest.fixture
def cut(whole: Path, tmp_path: Path) -> Path:
    """The run after a power failure half-way."""
    out = tmp_path / "run"
    out.mkdir()
    log = (whole / "log.mcap").read_bytes()
    (out / "log.mcap").write_bytes(log[: len(log) // 2])
    return out


def test_the_log_of_a_run_stands_for_its_folder(whole: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run("resume", whole / "log.mcap") == 0
    assert "already complete" in capfd.readouterr().err


def test_a_run_is_resumed_with_all_its_options(
    cut: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    num_kept = read_log(cut / "log.mcap").num_steps()
    assert 0 < num_kept < 6
    assert run("resume", cut, "--json", "--quiet") == 0
    metrics = json.loads(capsys.readouterr().out)
    assert (metrics["num_scans"], metrics["num_scans_resumed"]) == (6, num_kept)
    assert (cut / "top.png").is_file()
    assert read_log(cut / "log.mcap").config.keyframes.distance_m == 4.0
    num_new = metrics["num_scans"] - metrics["num_scans_resumed"]
    assert num_new / metrics["scans_per_second"] < metrics["seconds_total"]  # which has the reading of the log in it
    assert run("resume", cut) == 0
    assert "no scan is left to map" in capsys.readouterr().err


def test_missing_data_is_reported(kitti: Path, cut: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    log = (cut / "log.mcap").read_bytes()
    shutil.move(kitti, tmp_path / "away")
    try:
        assert run("resume", cut) == 2
    finally:
        shutil.move(tmp_path / "away", kitti)
    message = capsys.readouterr().err.strip()
    assert str(kitti) in message
    assert "Restore it" in message
    assert len(message.splitlines()) == 1
    assert (cut / "log.mcap").read_bytes() == log


@pytest.mark.parametrize("folder", ["nowhere", "."])
def test_a_folder_without_a_run_is_refused(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("resume", folder) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_dry_run_shows_what_was_found_and_writes_nothing(
    kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ("map", kitti, "--dry-run", "--frames", "2:8", "--set", "keyframes.distance_m=4")
    assert run(*arguments, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["data"], found["num_scans"], found["first_scan"], found["last_scan"]) == ("kitti/00", 6, 2, 7)
    assert found["scans_per_second"] == pytest.approx(1 / 0.3)
    assert found["num_true_poses"] == 6
    assert found["vertical_angle_deg"] == 0.205
    assert found["labels"] == "geometric"
    assert found["first_usable_scan"]["num_points"] > 1000
    assert found["changed_settings"] == {"keyframes.distance_m": "4.0"}
    assert run(*arguments) == 0
    shown = capsys.readouterr().out
    assert "6 scans, 2 to 7" in shown
    assert "degrees, +0.205 of correction; point times" in shown  # that of KITTI's layout
    assert "point times: none, so the odometry does not compensate the motion" in shown
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_of_unusable_scans_gives_the_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("0.bin", "1.bin"):
        (tmp_path / name).write_bytes(bytes(17))
    assert run("map", tmp_path, "--dry-run") == 2
    assert "0.bin: 17 bytes are not a multiple of 16" in capsys.readouterr().err


def test_without_a_folder_to_write_to_nothing_is_mapped(kitti: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("map", kitti) == 2
    assert "--out" in capsys.readouterr().err


def test_a_run_is_finished_though_its_last_scan_cannot_be_read(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    (tmp_path / "run" / "report.html").write_text("")
    recorded, last = read_log(tmp_path / "run"), int(made.result.trajectory.scan_index[-1])

    class Scans(Dataset):
        def __init__(self, *more: int) -> None:
            self.scan_index = np.array([last - 1, last, *more])
            self.read: list[int] = []

        def __getitem__(self, row: int) -> Scan:
            self.read.append(row)
            if row == 2 and self.scan_index[2] == last + 1:
                raise BadScan("cut")
            return Scan(np.ones((3, 3), np.float32), stamp_ns=row, index=int(self.scan_index[row]))

    whole, cut, longer = Scans(), Scans(last + 1), Scans(last + 2)
    assert is_finished(recorded, whole)
    assert whole.read == [], "a recording would be read to its end"
    assert is_finished(recorded, cut)
    assert not is_finished(recorded, longer)


def test_a_finished_run_that_needs_no_data_is_complete(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A live run, a merged one, a replay; but not a replay that Ctrl-C ended."""
    folder = make_run(tmp_path / "run").folder
    assert run("resume", folder) == 2, "there is no report yet"
    (folder / "report.html").write_text("")
    capsys.readouterr()
    assert run("resume", folder, "--json") == 0
    shown = capsys.readouterr()
    assert "the run is already complete" in shown.err
    assert json.loads(shown.out)["num_scans"] == 120
    (folder / "metrics.json").write_text('{"num_scans_left": 3}')
    assert run("resume", folder) == 2


@pytest.mark.parametrize(
    "options",
    [{"live": "folder"}, {"sessions": "[1]"}, {"data": "scans", "python": "odometry"}, {"data": "scans", "python": ""}],
)
def test_info_suggests_only_what_resume_accepts(
    options: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scans").mkdir()
    LogWriter(tmp_path / "log.mcap", config=Config(), dataset="generic/scans", options=options).close()
    assert run("info", tmp_path) == 0
    shown = capsys.readouterr().out
    assert "interrupted" in shown
    assert run("resume", tmp_path) == 2
    is_tried = "found neither" in capsys.readouterr().err
    assert is_tried is (options.get("python") == "")
    assert ("segslam resume" in shown) is is_tried


def test_the_angle_that_kittis_data_has_by_default_is_no_changed_setting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load_config(None, ["sensor.vertical_angle_deg=0.205", "map.color=height"])
    LogWriter(tmp_path / "log.mcap", config=config, dataset="kitti/00", T_camera_lidar=np.eye(4)).close()
    assert run("info", tmp_path, "--json", "--quiet") == 0
    assert json.loads(capsys.readouterr().out)["changed_settings"] == {"map.color": "height"}
