"""Damaged runs, odd names and foreign run folders: one clear line, and nothing outside of the run is written."""

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import round_drive
from helpers.finished_run import make_run
from helpers.made_logs import boundaries

from segslam.cli import _with_home
from segslam.core.config import Config
from segslam.core.types import SegslamError
from segslam.output.finished import read_metrics
from segslam.output.log import LogWriter, read_log
from segslam.run.map_folder import map_folder, resume_options
from segslam.run.run import Run
from segslam.scans import DataSource
from segslam.slam.slam import Slam

pytestmark = pytest.mark.usefixtures("short_runs")


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of four scans."""
    folder = tmp_path_factory.mktemp("scans")
    for scan in round_drive()[0][:4]:
        rows = np.column_stack([scan.points, np.zeros(len(scan.points))])
        rows.astype("<f4").tofile(folder / f"{scan.index:06d}.bin")
    return folder


@pytest.mark.parametrize("command", ["map", "calibrate", "fleet", "label --labels geometric"])
def test_a_run_is_no_data(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its map.ply was mapped as a scan."""
    folder = make_run(tmp_path / "run").folder
    (folder / "map.ply").write_bytes(b"")
    assert run(*command.split(), folder, *(() if command == "calibrate" else ("--out", tmp_path / "other"))) == 2
    assert f"{folder}: the folder of a run; give the data that it was made from" in capsys.readouterr().err


def _started(out: Path, scans: Path, **options: str) -> Path:
    """A run that was interrupted before its first step, with these options in its log."""
    out.mkdir()
    LogWriter(out / "log.mcap", config=Config(), dataset=f"generic/{scans.name}", options=options).close()
    return out


def test_export_of_a_damaged_log_writes_no_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_run(tmp_path / "run").folder
    data = bytearray((folder / "log.mcap").read_bytes())
    data[boundaries(folder / "log.mcap")[60] + 200] ^= 1
    (folder / "log.mcap").write_bytes(data)
    assert run("export", folder, tmp_path / "map.ply", "-q") == 2
    assert "log.mcap: damaged, only 30 of its" in capsys.readouterr().err
    assert not (tmp_path / "map.ply").exists()
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("content", ["[1]", "1", '{"ate_m": "x"}', '{"stage_ms": {"a": 1}}', '{"odometry_ate_m": []}'])
def test_damaged_figures_are_refused_by_name(tmp_path: Path, content: str) -> None:
    (tmp_path / "metrics.json").write_text(content)
    with pytest.raises(SegslamError, match=r"metrics\.json: cannot read the figures"):
        read_metrics(tmp_path)


def test_a_figure_that_is_null_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text('{"ate_m": null, "num_scans": 3}')
    assert read_metrics(tmp_path) == {"num_scans": 3}


def test_a_dollar_in_a_name_is_no_formula(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / name).folder for name in (r"a $\frac{$", "b")]
    assert run("compare", *folders, "--plot", tmp_path / "x.png", "-q") == 0
    assert (tmp_path / "x.png").is_file()


def test_a_home_folder_is_expanded_behind_an_option_and_an_unknown_user_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    assert _with_home("--out=~/runs") == "--out=/home/me/runs"
    assert _with_home("~/runs") == "/home/me/runs"
    assert _with_home("runs/~x") == "runs/~x"
    monkeypatch.chdir(tmp_path)
    assert run("map", "~nosuch/x", "--out", "run") == 2
    assert "~nosuch/x: there is no such user" in capsys.readouterr().err


def test_an_empty_path_is_not_the_present_folder(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for command in (("map", ""), ("map", scans, "--out", ""), ("register", scans / "000000.bin", ""), ("info", "")):
        assert run(*command) == 2
        assert f"empty text after '{command[-2]}': give a path, `.` for this folder" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert run("map", scans, "--dry-run", "--topic", "", "-q") == 0  # the default


@pytest.mark.parametrize("command", [("map", "LONG", "--out", "run"), ("info", "LONG"), ("map", ".", "--out", "LONG")])
def test_a_name_that_is_too_long_is_refused_in_one_line(
    command: tuple[str, ...], scans: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(scans)
    for name in ("n" * 300, "p/" * 2500):
        assert run(*(word.replace("LONG", name) for word in command)) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.endswith("(File name too long); check the path and its permissions")
        assert len(line) < 200


def test_a_present_folder_that_was_removed_is_named(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert run("map", scans, "--out", "run") == 2
    assert "segslam: the present folder: no such file or folder" in capsys.readouterr().err


@pytest.mark.parametrize("option", [("--gnss-use", "align"), ("--gnss-offset", "5"), ("--gnss-offset", "nan")])
def test_options_of_position_fixes_are_refused_without_fixes(
    option: tuple[str, str], scans: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("map", scans, "--dry-run", *option) == 2
    assert "only for position fixes; give them with --gnss" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_whose_data_has_an_odd_name_is_resumed(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """A byte that is not UTF-8, its escape as a name, and a letter that is not ASCII."""
    caplog.set_level(logging.CRITICAL)  # xdist cannot send the name
    odd, folder = tmp_path / os.fsdecode(b"\xff \\udcff \xc3\xa9"), tmp_path / os.fsdecode(b"run\xff")
    shutil.copytree(scans, odd)
    assert run("map", odd, "--out", folder, "--map-file", os.fsdecode(b"top\xff.png"), "-q") == 0
    options, log = read_log(folder / "log.mcap").options, (folder / "log.mcap").read_bytes()
    assert options["data"] == str(odd)
    for file in folder.iterdir():
        file.unlink()
    folder.joinpath("log.mcap").write_bytes(log[: len(log) // 2])
    assert run("resume", folder, "--json", "-q") == 0
    assert json.loads(capsys.readouterr().out)["num_scans"] == 4
    assert (folder / os.fsdecode(b"top\xff.png")).is_file()


@pytest.mark.slow
def test_a_command_of_a_shell_takes_a_name_that_is_not_utf_8(scans: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"scans\xff")
    odd.symlink_to(scans)
    words = [sys.executable, "-m", "segslam", "map", os.fsencode(odd), "--out", str(tmp_path / "run"), "--json", "-q"]
    ended = subprocess.run(words, capture_output=True)
    assert ended.returncode == 0, ended.stderr.decode()
    assert json.loads(ended.stdout)["num_scans"] == 4


def test_a_run_that_fails_at_its_start_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("odd")

    monkeypatch.setattr("segslam.run.run.LogWriter", fails)
    (tmp_path / "run").mkdir()
    with pytest.raises(RuntimeError):
        Run(tmp_path / "run", Slam(), dataset="made")
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_writes_no_file_outside_that_its_log_names(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("../up.ply", "/tmp/up.ply", "sub/../../up.ply")
    options = resume_options(DataSource(scans)) | {"map_files": json.dumps([*names, "inside.png"])}
    folder = _started(tmp_path / "run", scans, **options)
    before = set(tmp_path.iterdir())
    assert run("resume", folder) == 0
    shown = capsys.readouterr().err
    for name in names:
        assert f"{name}: not written, because it is outside of {folder}" in shown
    assert (folder / "inside.png").is_file()
    assert set(tmp_path.iterdir()) == before
    assert not Path("/tmp/up.ply").exists()


@pytest.mark.parametrize("name", ["metrics.json", ".poses_tum.txt.part", "report.html"])
@pytest.mark.parametrize("command", ["resume", "report", "eval", "georeference"])
def test_a_run_with_a_link_to_outside_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, name: str
) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    folder = make_run(tmp_path / "run").folder
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(victim)
    assert run(command, folder) == 2
    assert f"{name}: a link to {victim}, outside of the run; remove the link" in capsys.readouterr().err
    assert victim.read_text() == "mine"


def test_a_run_of_an_older_version_without_some_options_is_resumed(scans: Path, tmp_path: Path) -> None:
    folder = _started(tmp_path / "run", scans, data=str(scans), labels="auto")
    assert run("resume", folder, "-q") == 0
    assert (folder / "report.html").is_file()


@pytest.mark.parametrize(("key", "value"), [("map_files", "null"), ("map_files", "{"), ("encoding", "odd")])
def test_a_log_with_a_damaged_option_is_refused_by_name(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str, value: str
) -> None:
    folder = _started(tmp_path / "run", scans, **(resume_options(DataSource(scans)) | {key: value}))
    assert run("resume", folder) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "log.mcap" in line


@pytest.mark.parametrize("value", ["{", "[1]", '[{"first_keyframe": 0}]'])
def test_a_log_with_damaged_sessions_is_not_replayed(
    value: str, scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = _started(tmp_path / "run", scans, sessions=value)
    assert run("replay", folder, "--out", tmp_path / "again", "-q") == 2
    assert "sessions of the log: " in capsys.readouterr().err
    assert not (tmp_path / "again").exists()


@pytest.mark.slow
def test_a_run_from_python_is_resumed_by_the_command(scans: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    map_folder(scans, folder, frames="0:3")
    options = read_log(folder / "log.mcap").options
    assert options["data"] == str(scans)
    assert options["frames"] == "0:3"
    data, ends = (folder / "log.mcap").read_bytes(), boundaries(folder / "log.mcap")
    (folder / "report.html").unlink()
    (folder / "log.mcap").write_bytes(data[: ends[1]])
    assert run("resume", folder, "-q") == 0
    assert len(list(read_log(folder / "log.mcap").steps())) == 3


def test_a_run_from_python_with_its_own_parts_is_not_resumed(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, data in enumerate((scans, tmp_path / "moved")):  # restored data would not help
        options = resume_options(DataSource(data)) | {"python": "odometry"}
        assert run("resume", _started(tmp_path / f"run_{number}", scans, **options)) == 2
        assert "made from Python with its own odometry" in capsys.readouterr().err
    map_folder(scans, tmp_path / "placed", frames="0:2", place=lambda _: "")
    assert run("resume", tmp_path / "placed") == 2
    assert "made from Python with its own place" in capsys.readouterr().err


def test_a_scan_that_is_needed_and_gone_is_reported_with_the_log(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, copied = tmp_path / "run", tmp_path / "scans"
    copied.mkdir()
    for file in scans.iterdir():
        (copied / file.name).write_bytes(file.read_bytes())
    assert run("map", copied, "--out", folder, "-q") == 0
    (folder / "report.html").unlink()
    data, ends = (folder / "log.mcap").read_bytes(), boundaries(folder / "log.mcap")
    (folder / "log.mcap").write_bytes(data[: ends[2]])
    for file in copied.iterdir():
        file.write_bytes(b"")
    assert run("resume", folder) == 2
    assert "restore it to resume, or: segslam replay" in capsys.readouterr().err
    assert len((folder / "log.mcap").read_bytes()) == ends[2]


SLOW_EXPORT = """
import sys, time
from segslam import cli
from segslam.output.map.write import MapStore
MapStore.add = lambda *_: time.sleep(60)
cli.main(["export", *sys.argv[1:]])
"""


@pytest.mark.long
def test_sigterm_during_an_export_leaves_no_unfinished_map(tmp_path: Path) -> None:
    folder, target = make_run(tmp_path / "run").folder, tmp_path / "map.ply"
    with subprocess.Popen([sys.executable, "-c", SLOW_EXPORT, folder, target], stderr=subprocess.PIPE) as process:
        end = monotonic() + 60
        while not list(tmp_path.glob(".map-*")) and monotonic() < end and process.poll() is None:
            sleep(0.05)
        assert list(tmp_path.glob(".map-*"))
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 130
        assert process.stderr is not None
        assert b"Traceback" not in process.stderr.read()
    assert not list(tmp_path.glob(".map-*"))
    assert not target.exists()
