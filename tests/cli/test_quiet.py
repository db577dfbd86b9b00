"""Interface of every command for scripts: `--json` prints one object (`locate`: a list) alone, `--quiet` prints
failures only.

File descriptors are watched, so that what libraries print without Python counts too.
"""

import json
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import all_commands, run
from helpers.drives import write_kitti_sequence
from helpers.finished_run import make_run
from typer.main import get_command

from segslam import cli
from segslam.bench.simulation import tracks
from segslam.cli import commands
from segslam.output import report

pytestmark = pytest.mark.usefixtures("short_runs")

WRITE_REPORT = report.write_report
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


@pytest.fixture(scope="module")
def mapped(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of the scans, made without output."""
    out = tmp_path_factory.mktemp("mapped") / "run"
    assert run("map", data, "--out", out, "--labels", "true_labels", "--quiet") == 0
    return out


def _places(out: Path) -> Path:
    """Six views from above, as `segslam bench places` reads them."""
    columns = np.random.default_rng(0).integers(0, 9, (6, 151, 151), dtype=np.uint8)
    np.savez(out.with_suffix(".npz"), columns=columns, poses=np.tile(np.eye(4)[:3], (6, 1, 1)))
    return out.with_suffix(".npz")


COMMANDS: dict[str, Callable[[Path, Path, Path], Words]] = {
    "map": lambda data, _, out: [data, "--out", out, "--map"],
    "refine": lambda _, finished, out: [finished, "--out", out],
    "fleet": lambda data, _, out: [data, "--out", out, "--workers", 1],
    "label": lambda data, _, out: [
        *(data, "--out", out, "--labels", "true_labels", "--truth", "true_labels", "--frames", "0:2")
    ],
    "sweep": lambda _, finished, out: [finished, "--set", "verify.max_false_share=0.01", "--out", out],
    "convert": lambda data, _, out: [data / "poses" / "00.txt", out],
    "info": lambda _, finished, __: [finished],
    "edit": lambda _, finished, out: [finished, "--forbid", "2:0", "--out", out],
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
    "doctor": lambda *_: [],
    "bench places": lambda _, __, out: [_places(out), "--database", "0:4", "--queries", "4:6"],
    "compare": lambda _, finished, out: [finished, shutil.copytree(finished, out)],
    "calibrate": lambda data, *_: [data],
    "demo": lambda _, __, out: ["--out", out],
    "bench pairs": lambda data, _, out: [data, *FEW, data / "pairs.txt", "--out", out],
    "bench timing": lambda data, _, __: [data, *FEW, data / "pairs.txt"],
    "bench yaw": lambda data, _, __: [data, *FEW, data / "pairs.txt", "--step-deg", 180],
    "bench deterioration": lambda data, _, __: [data, *FEW, data / "pairs.txt", "--lost", 50, "--draws", 1],
}
"""Arguments of each command, given the data, a run that was made up, and a new name."""
OF_MAPPED: dict[str, Callable[[Path, Path, Path], Words]] = {
    "locate": lambda data, mapped, _: [mapped, data / "sequences/00/velodyne/000003.bin", "--dataset", "kitti"],
    "localise": lambda data, mapped, out: [mapped, data, "--out", out],
    "resume": lambda _, mapped, __: [mapped],
}
"""The same, given a run of the data."""


@pytest.fixture(autouse=True)
def short_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = tracks.example_drive()
    short = replace(drive, T_world_lidar=drive.T_world_lidar[:2], time_s=drive.time_s[:2])
    monkeypatch.setattr(tracks, "example_drive", lambda *_, **__: short)


@pytest.fixture(params=[*COMMANDS, *OF_MAPPED])
def words(request: pytest.FixtureRequest, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Words:
    """A command with its arguments; `report` alone draws."""
    name, out = str(request.param), tmp_path / "out"
    if name == "report":
        monkeypatch.setattr("segslam.output.report.write_report", WRITE_REPORT)
    if name in OF_MAPPED:
        return [*name.split(), *OF_MAPPED[name](data, request.getfixturevalue("mapped"), out)]
    return [*name.split(), *COMMANDS[name](data, request.getfixturevalue("finished"), out)]


def test_every_command_is_tried_here() -> None:
    commands.add(cli.app)
    elsewhere = {"live", "merge", "georeference"}  # an endless source, longer drives: tests/live, sessions, run
    assert {*COMMANDS, *OF_MAPPED} | elsewhere == {name for name, _ in all_commands(get_command(cli.app))}


@pytest.mark.long
def test_json_is_one_value_and_nothing_else(words: Words, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(*words, "--json") == 0
    assert isinstance(json.loads(capfd.readouterr().out), list if words[0] == "locate" else dict)


@pytest.mark.long
def test_quiet_prints_failures_only(
    words: Words, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # pytest's would take the warnings
    assert run(*words, "--quiet") == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert not out or words[0] not in {"compare", "eval", "sweep"}, "a table"


def test_quiet_still_prints_a_failure(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run("map", tmp_path / "nowhere", "--out", tmp_path / "out", "--quiet") == 2
    assert capfd.readouterr().err.startswith("segslam: ")
