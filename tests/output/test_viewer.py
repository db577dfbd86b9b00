"""Data that a viewer receives from a run; a missing viewer is reported."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.commands import run
from helpers.drives import write_kitti_sequence
from helpers.made_logs import made_steps, write_log

from segslam.core.types import Motion, MotionState, Step

RecordingStream = pytest.importorskip("rerun").RecordingStream


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    return list(made_steps(60))


def test_a_run_is_saved_for_rerun_with_its_clouds_paths_and_loops(steps: list[Step], tmp_path: Path) -> None:
    write_log(tmp_path / "log.mcap", steps)
    assert run("view", tmp_path, "--save", tmp_path / "run.rrd", "--quiet") == 0
    entities = _entities(tmp_path / "run.rrd")
    attempts = [attempt for step in steps for attempt in step.attempts]
    keyframes = {f"/world/keyframes/{step.keyframe.id}" for step in steps if step.keyframe is not None}
    assert keyframes <= entities
    loops = {entity.rpartition("/")[2] for entity in entities if entity.startswith("/world/loops/")}
    assert len(loops) == len(attempts)
    assert {"/world/trajectory", "/world/odometry", "/world/lidar", "/stage_ms/odometry"} <= entities


def test_another_ending_than_rerun_s_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(tmp_path / "log.mcap", [])
    assert run("view", tmp_path, "--save", tmp_path / "run.ply") == 2
    assert "run.ply: Rerun's files end in .rrd" in capsys.readouterr().err
    assert not (tmp_path / "run.ply").exists()


def test_motions_that_were_repaired_or_broken_or_rejected_are_marked(steps: list[Step], tmp_path: Path) -> None:
    made = list(steps)
    states = {10: MotionState.REPAIRED, 20: MotionState.BROKEN, 30: MotionState.CONFIRMED}
    for row, state in states.items():
        made[row] = replace(made[row], motion=Motion(state, 0.4, 2.0, 0.9))
    last = max(row for row, step in enumerate(made) if step.estimate is not None)
    estimate = made[last].estimate
    assert estimate is not None
    made[last] = replace(made[last], estimate=replace(estimate, motion_weights={(0, 1): 0.0}))
    write_log(tmp_path / "log.mcap", made)
    assert run("view", tmp_path, "--save", tmp_path / "run.rrd", "--quiet") == 0
    entities = _entities(tmp_path / "run.rrd")
    marked = {entity.rpartition("/")[2] for entity in entities if "/motions/" in entity}
    assert marked == {str(made[row].scan_index) for row in (10, 20)}
    assert "/world/motions_rejected" in entities


@pytest.mark.usefixtures("short_runs")
def test_mapping_can_be_watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer that opens no window, and writes what it is sent to a file."""
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(RecordingStream, "spawn", lambda stream: stream.save(tmp_path / "run.rrd"))
    write_kitti_sequence(tmp_path, num_scans=4)
    assert run("map", tmp_path, "--frames", "0:4", "--out", tmp_path / "run", "--view", "--quiet") == 0
    assert {f"/world/keyframes/{number}" for number in range(4)} <= _entities(tmp_path / "run.rrd")


def test_the_viewer_is_found_beside_python_though_not_on_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """If it does not start, the first line of its error is printed."""

    def spawn(_: RecordingStream) -> None:
        raise RuntimeError(f"found {shutil.which('rerun')}\nand how to install it, in many lines")

    write_log(tmp_path / "log.mcap", [])
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(RecordingStream, "spawn", spawn)
    assert run("view", tmp_path) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert f"found {Path(sys.executable).parent}" in message


def _entities(file: Path) -> set[str]:
    command = [sys.executable, "-m", "rerun", "rrd", "stats", str(file)]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return {line.partition(":")[0] for line in listed.splitlines() if line.startswith("/")}


def test_without_the_viewer_one_line_has_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(tmp_path / "log.mcap", [])
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert run("view", tmp_path, "--save", tmp_path / "run.rrd") == 2
    assert "pip install 'rerun-sdk<" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["view", "RUN"], ["map", "RUN", "--out", "new", "--view"]])
def test_without_a_display_the_viewer_is_refused_at_once(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RecordingStream, "spawn", lambda stream: pytest.fail("the viewer was started"))
    assert run(*command) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert "no display" in message
    assert "--save" in message
    assert not list(tmp_path.iterdir())


def test_waiting_for_a_stuck_viewer_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def flush(_: RecordingStream, *, timeout_sec: float) -> None:
        assert timeout_sec <= 60
        raise RuntimeError("timed out")

    write_log(tmp_path / "log.mcap", [])
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(RecordingStream, "spawn", lambda stream: stream.save(tmp_path / "run.rrd"))
    monkeypatch.setattr(RecordingStream, "flush", flush)
    assert run("view", tmp_path, "--quiet") == 2
    assert "does not answer (timed out)" in capsys.readouterr().err
