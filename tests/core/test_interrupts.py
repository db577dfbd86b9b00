"""Ctrl-C at any moment: one line with the kept results and the command that continues."""

import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.drives import write_kitti_sequence

from segslam import cli
from segslam.cli.console import Terminal

pytestmark = pytest.mark.usefixtures("ctrl_c_works", "short_runs")

LOADING = """
import os, signal, sys
sys.path.insert(0, sys.argv[1])
from segslam.core.interrupts import ctrl_c_in_order
with ctrl_c_in_order():
    import interrupted_while_it_loads
print("went on")
"""
WRITING = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from segslam.core.interrupts import ctrl_c_in_order
from segslam.core.whole_files import temporary_folder, whole_file
with ctrl_c_in_order(), whole_file(Path(sys.argv[1], "half.txt")) as part:
    part.write_text("half")
    with temporary_folder(Path(sys.argv[1]), ".map-") as scratch:
        (scratch / "half").touch()
        import interrupted_while_it_loads
"""
IMPATIENT = """
import signal
from segslam.core.interrupts import ctrl_c_in_order, when_stopped
with ctrl_c_in_order():
    when_stopped("the log is kept")
    for _ in range(3):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            pass
print("went on")
"""


def run(*arguments: object) -> int:
    """Exit status of a command line, which is also that of the process."""
    words = [str(argument) for argument in arguments]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["segslam", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main(words)
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    ("script", "kept"),
    [
        (LOADING, "nothing was written"),
        (WRITING, "nothing was written"),
        (IMPATIENT, "the log is kept"),
    ],
)
def test_the_process_ends_at_once_while_modules_load_and_at_the_third(tmp_path: Path, script: str, kept: str) -> None:
    """An extension module that is interrupted while it loads raises an ImportError, or nothing."""
    (tmp_path / "interrupted_while_it_loads.py").write_text(
        "import signal\ntry: signal.raise_signal(signal.SIGINT)\nexcept KeyboardInterrupt: raise ImportError\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", f"segslam: stopped: {kept}\n")
    assert {path.name for path in tmp_path.iterdir()} <= {"interrupted_while_it_loads.py", "__pycache__"}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_kitti_sequence(folder, num_scans=5)
    return folder


def interrupt_after(num_scans: int, monkeypatch: pytest.MonkeyPatch, *, command: str = "map") -> None:
    """Ctrl-C is pressed when the bar of the command has come so far; the run is not ahead of the bar."""

    def interrupted(_: Terminal, items: Iterable[Any], total: int, title: str) -> Iterator[Any]:
        for number, item in enumerate(items):
            if title == command and number == num_scans:
                signal.raise_signal(signal.SIGINT)
            yield item

    monkeypatch.setattr(Terminal, "progress", interrupted)
    monkeypatch.setattr("segslam.run.run.MOST_WAITING", 0)


def test_an_interrupted_run_continues_with_the_printed_command(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["map", data, "--out", tmp_path / "a run"]
    with monkeypatch.context() as patch:
        interrupt_after(2, patch)
        assert run(*command, "--quiet") == 130
    (line,) = capsys.readouterr().err.splitlines()
    output = line.partition("continue with: segslam ")[2]
    assert line.startswith("segslam: stopped: ")
    assert shlex.split(output)[:2] == ["resume", str(tmp_path / "a run")]
    assert run("info", tmp_path / "a run", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["state"] == "interrupted"
    assert found["num_steps"] + found["figures"]["num_scans_left"] == 5
    assert run(*shlex.split(output), "--json") == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["num_scans"] == 5
    assert "num_scans_left" not in metrics


def test_an_interrupted_replay_tells_how_many_scans_are_left(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("map", data, "--out", tmp_path / "run", "--quiet") == 0
    interrupt_after(2, monkeypatch, command="replay")
    assert run("replay", tmp_path / "run", "--out", tmp_path / "again", "--quiet") == 130
    capsys.readouterr()
    assert run("info", tmp_path / "again", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["state"] == "interrupted"
    assert found["num_steps"] + found["figures"]["num_scans_left"] == 5
    assert run("info", tmp_path / "again") == 0
    assert "segslam resume" not in capsys.readouterr().out, "it refuses a replay"


def test_before_the_first_scan_nothing_is_left(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("segslam.run.run.Run.follow", _interrupted)
    assert run("map", data, "--out", tmp_path / "run", "--quiet") == 130
    assert capsys.readouterr().err == "segslam: stopped: no scan was mapped, nothing was written\n"
    assert not list(tmp_path.iterdir())


def _interrupted(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("content", [b"", bytes(160), b"\xff" * 160, b"x" * 23])
def test_a_folder_without_a_usable_scan_is_one_line_and_leaves_nothing(
    tmp_path: Path, content: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    for number in range(3):
        (scans / f"{number}.bin").write_bytes(content)
    assert run("map", scans, "--out", tmp_path / "run", "--quiet") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "generic/scans: none of 3 scans could be used; the first: " in line
    assert not (tmp_path / "run").exists()


def test_the_folder_of_a_map_file_is_made_or_refused_before_mapping(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["map", data, "--frames", "0:2", "--out", tmp_path / "run", "--quiet"]
    assert run(*command, "--map-file", tmp_path / "nowhere" / "x.ply") == 2
    assert "there is no folder" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    (tmp_path / "kept.ply").write_text("another map")
    assert run(*command, "--map-file", "../kept.ply") == 2, "outside the folder of the run"
    assert "kept.ply: exists" in capsys.readouterr().err
    assert (tmp_path / "kept.ply").read_text() == "another map"
    assert run(*command, "--map-file", "sub/x.ply") == 0
    assert (tmp_path / "run" / "sub" / "x.ply").is_file()


def _has_begun(file: Path) -> bool:
    """Whether a file is there; one of results also has a row below its header."""
    return file.exists() and (file.suffix != ".csv" or file.read_text().count("\n") > 1)


@pytest.mark.parametrize(
    ("command", "begun", "kept"),
    [
        (
            ("demo", "--out", "FOLDER/demo"),
            "demo/data/sequences/00/velodyne/000001.bin",
            "to start again: segslam demo",
        ),
        (
            (
                "bench",
                "yaw",
                "DATA",
                "--step-deg",
                "1",
                "--method",
                "gicp",
                "--pairs",
                "DATA/pairs.txt",
                "--out",
                "FOLDER/b",
            ),
            "b/details.csv",
            "the same command continues",
        ),
    ],
)
def test_a_real_ctrl_c_ends_in_one_line_and_leaves_no_half_file(
    data: Path, tmp_path: Path, command: tuple[str, ...], begun: str, kept: str
) -> None:
    (data / "pairs.txt").write_text("1 0\n")
    words = [word.replace("FOLDER", str(tmp_path)).replace("DATA", str(data)) for word in command]
    with subprocess.Popen([sys.executable, "-m", "segslam", *words], stderr=subprocess.PIPE, text=True) as process:
        try:
            while not _has_begun(tmp_path / begun) and process.poll() is None:
                time.sleep(0.01)
            process.send_signal(signal.SIGINT)
            _, expected = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130, expected
    *_, line = expected.splitlines()
    assert line.startswith("segslam: stopped: ")
    assert kept in line
    assert "Traceback" not in expected
    assert not [file for file in tmp_path.rglob("*") if file.suffix == ".part" or ".map-" in file.name]
