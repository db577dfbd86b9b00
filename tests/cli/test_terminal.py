"""Commands under a pseudo-terminal, because a progress bar behaves differently in a pipe."""

import json
import re
import sys
from pathlib import Path

import pytest
from helpers.terminal import in_terminal

from segslam.cli.console import Terminal
from segslam.core import kernels

DRIVER = """
import json, sys
from dataclasses import replace
import segslam.bench.simulation.tracks
from segslam.cli import main

real = segslam.bench.simulation.tracks.example_drive

def short_drive(*options, **more):
    drive = real(*options, **more)
    return replace(drive, T_world_lidar=drive.T_world_lidar[:NUM_SCANS], time_s=drive.time_s[:NUM_SCANS])

segslam.bench.simulation.tracks.example_drive = short_drive  # the demo's has hundreds of scans
if __name__ == "__main__":  # else the process of the odometry runs it too
    for command in json.load(open(sys.argv[1])):
        try:
            main(command)
        except SystemExit as ended:
            print(f"\\n== {command[0]} {ended.code}", flush=True)
"""
GRAPH = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1
"""


def shown_by_command(folder: Path, commands: list[list[str]], *, num_scans: int) -> list[tuple[str, int, str]]:
    """Name, exit status and what was shown of each command; all in one process, which loads its modules once."""
    (folder / "commands.json").write_text(json.dumps(commands))
    driver = folder / "driver.py"
    driver.write_text(DRIVER.replace("NUM_SCANS", str(num_scans)))
    status, shown = in_terminal(str(driver), str(folder / "commands.json"))
    assert status == 0, shown
    parts = re.split(r"== ([\w-]+) (\d+)\r?\n", shown)
    return [(name, int(ended), text) for text, name, ended in zip(parts[0::3], parts[1::3], parts[2::3], strict=False)]


@pytest.mark.slow
@pytest.mark.parametrize("num_scans", [1, 3])
def test_every_command_works_in_a_terminal(tmp_path: Path, num_scans: int) -> None:
    data, run, again = (str(tmp_path / name) for name in ("data", "run", "again"))
    scan = f"{data}/sequences/00/velodyne/000000.bin"
    (tmp_path / "pairs.txt").write_text(f"{num_scans - 1} 0\n")
    (tmp_path / "in.g2o").write_text(GRAPH)
    commands = [
        ["simulate", data, "--frames", str(num_scans), "--sensor", "vlp16"],
        ["map", data, "--out", run, "--map"],
        ["replay", run, "--out", again],
        ["report", run],
        ["export", run, str(tmp_path / "map.ply"), str(tmp_path / "grid.yaml")],
        ["register", scan, scan, "--dataset", "kitti"],
        ["bench", "timing", data, "--pairs", str(tmp_path / "pairs.txt"), "--method", "segregator"],
        ["optimize", str(tmp_path / "in.g2o"), "--out", str(tmp_path / "out.g2o")],
        ["warm-up"],
        ["demo", "--out", str(tmp_path / "demo")],
    ]
    if num_scans >= 3:
        commands.append(["eval", run])
    if pytest.importorskip("rerun"):
        commands.append(["view", run, "--save", str(tmp_path / "run.rrd")])
    shown = shown_by_command(tmp_path, commands, num_scans=num_scans)
    assert [(name, status) for name, status, _ in shown] == [(command[0], 0) for command in commands], shown
    counts = {"simulate", "map", "replay", "export", "demo", "view"}
    for name, _, text in shown:
        assert "Traceback" not in text, text
        assert text.strip(), f"{name} shows nothing"
        if name in counts:
            assert f"{num_scans}/{num_scans}" in text, text


def test_there_is_no_bar_without_items(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert list(Terminal().progress(iter(()), total=0, title="refine 1/1")) == []
    assert capsys.readouterr().err == ""


def test_a_bar_passes_all_items_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert list(Terminal().progress(iter(range(3)), total=3, title="count")) == [0, 1, 2]


def test_a_bar_is_full_where_fewer_items_were_needed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert list(Terminal().progress(iter(range(3)), total=19, title="locate")) == [0, 1, 2]
    assert "3/3" in capsys.readouterr().err


def test_the_rate_is_that_of_this_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    seconds = iter([0.0, *([1.0] * 100), 11.0, 21.0])
    monkeypatch.setattr("segslam.cli.console.monotonic", lambda: next(seconds))
    assert len(list(Terminal().progress(range(102), total=102, title="bench", num_before=100))) == 102
    assert capsys.readouterr().err.splitlines() == [
        "bench: 101/102, 0.1/s, 11 s left",
        "bench: 102/102, 0.1/s, 0 s left",
    ]


@pytest.mark.slow
def test_the_first_command_on_a_machine_shows_that_it_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    status, shown = in_terminal("-m", "segslam", "simulate", str(tmp_path / "s"), "--frames", "2", "--sensor", "vlp16")
    assert status == 0, shown
    status, shown = in_terminal("-m", "segslam", "map", str(tmp_path / "s"), "--out", str(tmp_path / "r"))
    assert status == 0, shown
    total = kernels.num_kernels()
    assert f"{total}/{total}" in shown
    assert shown.index("compiling, once") < shown.index("2/2")
    status, shown = in_terminal("-m", "segslam", "map", str(tmp_path / "s"), "--out", str(tmp_path / "again"))
    assert status == 0
    assert "compiling" not in shown
