"""Outputs of every command on a full disk and over odd targets: one line, exit status 2, no half file."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.commands import run
from helpers.finished_run import make_run, write_blank_report
from helpers.made_logs import largest_file

from segslam.core.geometry import transform, yaw
from segslam.core.types import SegslamError, WorkFailed
from segslam.core.whole_files import set_aside, settle, temporary_folder, whole_file, write_whole
from segslam.graph.edges import Edge
from segslam.graph.g2o import G2oGraph, write_g2o


def test_a_signal_while_a_temporary_folder_is_made_leaves_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mkdir = os.mkdir

    def interrupted(*arguments: object, **keywords: object) -> None:
        mkdir(*arguments, **keywords)  # type: ignore[arg-type]
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "mkdir", interrupted)
    with pytest.raises(KeyboardInterrupt), temporary_folder(tmp_path, ".map-"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_command_set_aside_is_put_back(tmp_path: Path) -> None:
    folder, aside = tmp_path / "run", tmp_path / ".run.replaced"
    aside.mkdir()
    (aside / "log.mcap").write_text("whole")
    folder.mkdir()
    (folder / "log.mcap").write_text("without a step")
    set_aside(folder)
    folder.mkdir()
    settle()
    assert [file.name for file in tmp_path.iterdir()] == ["run"]
    assert (folder / "log.mcap").read_text() == "whole"


def test_what_a_killed_command_set_aside_is_removed_when_the_new_run_has_a_step(tmp_path: Path) -> None:
    for name in ("run", ".run.replaced"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.mcap").write_text(name)
    settle(tmp_path / "run")
    assert [file.name for file in tmp_path.iterdir()] == ["run"]
    assert (tmp_path / "run" / "log.mcap").read_text() == "run"


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    import numpy as np

    poses = {i: transform(yaw(0.1 * i), [float(i), 0.0, 0.0]) for i in range(200)}
    edges = [Edge(i, i + 1, np.linalg.inv(poses[i]) @ poses[i + 1], np.eye(6)) for i in range(199)]
    write_g2o(tmp_path / "in.g2o", G2oGraph(poses, edges))
    return tmp_path / "in.g2o"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "run").folder


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_file_appears_when_it_is_whole(tmp_path: Path) -> None:
    file = tmp_path / "out.txt"
    write_whole(file, "before")
    with pytest.raises(WorkFailed, match=r"out\.txt: cannot be written \(File too large\)"), largest_file(10):
        write_whole(file, 100 * "x")
    assert file.read_text() == "before"
    with pytest.raises(WorkFailed, match=r"\(Read-only file system\); make it writable, or give"), whole_file(file):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))
    with pytest.raises(ZeroDivisionError):
        _fail_midway(file)
    assert file.read_text() == "before"
    assert list(tmp_path.iterdir()) == [file]


def _fail_midway(file: Path) -> None:
    with whole_file(file) as part:
        part.write_text("half")
        raise ZeroDivisionError


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("before")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_whole(tmp_path / "link.txt", "after")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "after"


def test_only_regular_files_are_replaced(
    graph: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "folder.g2o").mkdir()
    for target in (tmp_path / "folder.g2o", Path("/dev/null"), tmp_path / "pipe.ply"):
        with pytest.raises(SegslamError, match="not a regular file"):
            write_whole(target, "x")
    assert run("optimize", graph, "--out", "/dev/null", "--force", "--quiet") == 2
    assert "not a regular file" in one_line(capsys)
    assert run("export", finished, tmp_path / "pipe.ply", "--quiet") == 2
    assert "not a regular file" in one_line(capsys)
    assert (tmp_path / "pipe.ply").is_fifo()
    assert run("bench", "pairs", tmp_path, "--details", "/dev/null", "--quiet") == 2
    assert "not a regular file" in one_line(capsys)
    assert Path("/dev/null").is_char_device()


def test_optimize_replaces_a_file_only_if_wanted(graph: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = graph.read_bytes()
    assert run("optimize", graph, "--out", graph, "--quiet") == 2
    assert "--overwrite" in one_line(capsys)
    assert graph.read_bytes() == before
    assert run("optimize", graph, "--out", graph, "--force", "--quiet") == 0
    assert graph.read_bytes() != before


@pytest.mark.long
def test_a_full_disk_is_one_line_and_leaves_no_half_file(
    graph: Path, finished: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    commands = [
        ("optimize", graph, "--out", tmp_path / "full.g2o"),
        ("export", finished, tmp_path / "full.ply"),
        ("report", finished),
    ]
    for command in commands:
        before = {file: file.stat().st_size for file in (*tmp_path.iterdir(), *finished.iterdir())}
        with largest_file(300):
            status = run(*command, "--quiet")
        (line,) = capfd.readouterr().err.splitlines()
        assert status == 2, command
        assert line.startswith("segslam: ")
        assert "cannot be written" in line
        assert {file: file.stat().st_size for file in (*tmp_path.iterdir(), *finished.iterdir())} == before


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans in KITTI's format, and a list of their pair."""
    folder = tmp_path_factory.mktemp("drive")
    assert run("simulate", folder, "--frames", 2, "--sensor", "vlp16", "--quiet") == 0
    (folder / "pairs.txt").write_text("1 0\n")
    return folder


def test_a_simulation_on_a_full_disk_ends_with_whole_scans_and_the_command_to_start_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, size in enumerate((10, 400, 3000, 200_000)):  # settings, calibration, labels and points do not fit
        with largest_file(size):
            assert run("simulate", tmp_path / str(number), "--frames", 2, "--sensor", "vlp16", "--quiet") == 2
        line = one_line(capsys)
        assert "standard output" not in line
        assert "free space there" in line
        files = [file for file in (tmp_path / str(number)).rglob("*") if file.is_file()]
        assert not [file for file in files if file.suffix in (".part", ".label", ".bin")]
    assert "stopped after 0 scans (No space left on device)" in line
    assert line.endswith("--overwrite")


@pytest.mark.parametrize("size", [10, 1500])
@pytest.mark.parametrize("option", ["--details", "--out"])
def test_a_benchmark_on_a_full_disk_leaves_no_half_file(
    drive: Path, tmp_path: Path, option: str, size: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither rows nor report fit, or only the rows; then the same command continues."""
    target = {"--details": tmp_path / "rows.csv", "--out": tmp_path / "report"}[option]
    bench = (
        "bench",
        "pairs",
        drive,
        "--pairs",
        drive / "pairs.txt",
        "--method",
        "segregator",
        option,
        target,
        "--quiet",
    )
    with largest_file(size):
        status = run(*bench)
    if (option, size) == ("--details", 1500):
        assert status == 0
    else:
        assert status == 2
        assert "File too large" in one_line(capsys)
        assert not [file for file in tmp_path.rglob("*") if file.is_file()]
    assert run(*bench, "--overwrite") == 0


def test_labels_on_a_full_disk_are_whole_or_not_there(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with largest_file(3000):
        assert run("label", drive, "--out", tmp_path / "labels", "--labels", "geometric", "--quiet") == 2
    assert "000000.label: cannot be written (No space left on device)" in one_line(capsys)
    assert not [file for file in tmp_path.rglob("*") if file.is_file()]


@pytest.mark.long
def test_view_saves_a_whole_file_or_none(finished: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    command = [sys.executable, "-m", "segslam", "view", str(finished), "--save", str(tmp_path / "full.rrd"), "--quiet"]
    with largest_file(5000):
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "full.rrd: cannot be written" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.long
@pytest.mark.parametrize("arguments", [["--help"], ["map", "--help"], ["eval", "RUN"], ["eval", "RUN", "--json"]])
def test_a_full_standard_output_is_one_line(finished: Path, arguments: list[str]) -> None:
    command = [sys.executable, "-m", "segslam", *(str(finished) if word == "RUN" else word for word in arguments)]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("segslam: ")
    assert "standard output: cannot be written (No space left on device); redirect it elsewhere" in line


@pytest.mark.long
def test_a_closed_pipe_is_not_reported_as_an_error(finished: Path) -> None:
    command = f"{sys.executable} -m segslam eval {finished} --json | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert done.stderr == ""


@pytest.mark.long
@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_a_command_whose_output_is_closed_does_its_work(graph: Path, tmp_path: Path, closed: str) -> None:
    command = f"{sys.executable} -m segslam optimize {graph} --json --out {tmp_path / 'a.g2o'}"
    done = subprocess.run(["bash", "-c", f"{command} {closed}"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("{") == (">&-" not in closed.split())
    assert (tmp_path / "a.g2o").read_text().startswith("VERTEX")


@pytest.mark.long
@pytest.mark.parametrize("command", [["report"], ["eval"], ["export"], ["view"], ["replay"]])
def test_a_run_is_named_by_its_folder_or_its_log(
    finished: Path,
    command: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if command == ["view"]:
        pytest.importorskip("rerun")
    if command == ["replay"]:
        monkeypatch.setattr("segslam.output.report.write_report", write_blank_report)
    for number, named in enumerate((finished, finished / "log.mcap")):
        more = {
            "export": [tmp_path / f"{number}.ply"],
            "view": ["--save", tmp_path / f"{number}.rrd"],
            "replay": ["--out", tmp_path / f"{number}"],
        }.get(command[0], [])
        assert run(*command, named, *more, "--quiet") == 0, capsys.readouterr().err
