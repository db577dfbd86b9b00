"""What scripts count on, of every command: `--json` prints one object alone, `--quiet` is heard only where it fails.

File descriptors are watched, so that what libraries print without Python counts too.
"""

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from drives import write_kitti_sequence
from finished_run import make_run
from test_cli_map import run
from test_docs import _all_commands
from typer.main import get_command

from segslam import cli, simulation
from segslam.cli import commands

Words = list[object]
FEW = ("--method", "segregator", "--labels", "true_labels", "--pairs")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four scans in KITTI's format, the third truncated, a list of pairs, and a graph."""
    root = tmp_path_factory.mktemp("kitti")
    broken = write_kitti_sequence(root, num_scans=4) / "000002.bin"
    broken.write_bytes(broken.read_bytes()[:-5])
    (root / "pairs.txt").write_text("3 0\n")
    vertices = "".join(f"VERTEX_SE3:QUAT {i} {i} 0 0 0 0 0 1\n" for i in range(3))
    information = " ".join(str(float(row == column)) for row in range(6) for column in range(row, 6))
    edges = "".join(f"EDGE_SE3:QUAT {i} {i + 1} 1.1 0 0 0 0 0 1 {information}\n" for i in range(2))
    (root / "graph.g2o").write_text(vertices + edges)
    return root


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("made") / "run").folder


COMMANDS: dict[str, Callable[[Path, Path, Path], Words]] = {
    "map": lambda data, _, out: [data, "--out", out, "--map"],
    "eval": lambda _, finished, __: [finished],
    "replay": lambda _, finished, out: [finished / "log.mcap", "--out", out],
    "register": lambda data, _, __: [*((data / f"sequences/00/velodyne/{i:06d}.bin") for i in (3, 0)), "--no-refine"],
    "optimize": lambda data, _, out: [data / "graph.g2o", "--out", out],
    "report": lambda _, finished, __: [finished],
    "view": lambda _, finished, out: [finished, "--save", out],
    "simulate": lambda _, __, out: [out, "--frames", 2, "--sensor", "vlp16"],
    "export": lambda _, finished, out: [
        finished,
        *(out.with_suffix(kind) for kind in (".ply", ".pcd", ".laz", ".png")),
    ],
    "warm-up": lambda *_: [],
    "demo": lambda _, __, out: ["--out", out],
    "bench pairs": lambda data, _, out: [data, *FEW, data / "pairs.txt", "--out", out],
    "bench timing": lambda data, _, __: [data, *FEW, data / "pairs.txt"],
    "bench yaw": lambda data, _, __: [data, *FEW, data / "pairs.txt", "--step-deg", 180],
    "bench deterioration": lambda data, _, __: [data, *FEW, data / "pairs.txt", "--lost", 50, "--draws", 1],
}


@pytest.fixture(autouse=True)
def short_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = simulation.made_up_drive()
    short = replace(drive, T_world_lidar=drive.T_world_lidar[:2], time_s=drive.time_s[:2])
    monkeypatch.setattr(simulation, "made_up_drive", lambda _=0: short)


def test_every_command_is_tried_here() -> None:
    commands.add_all(cli.app)
    assert set(COMMANDS) == {name for name, _ in _all_commands(get_command(cli.app))}


@pytest.mark.parametrize("name", COMMANDS)
def test_json_is_one_object_and_nothing_else(
    name: str, data: Path, finished: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(*name.split(), *COMMANDS[name](data, finished, tmp_path / "out"), "--json") == 0
    assert isinstance(json.loads(capfd.readouterr().out), dict)


@pytest.mark.parametrize("name", COMMANDS)
def test_quiet_says_nothing_that_is_no_failure(
    name: str,
    data: Path,
    finished: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # pytest's would take the warnings
    assert run(*name.split(), *COMMANDS[name](data, finished, tmp_path / "out"), "--quiet") == 0
    assert capfd.readouterr().err == ""


def test_quiet_still_tells_of_a_failure(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run("map", tmp_path / "nowhere", "--out", tmp_path / "out", "--quiet") == 2
    assert capfd.readouterr().err.startswith("segslam: ")
