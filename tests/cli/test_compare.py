"""`segslam compare`, `eval --plot` and `doctor` as typed."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.commands import run
from helpers.finished_run import make_run
from matplotlib.image import imread

from segslam.cli import doctor
from segslam.core import extras
from segslam.core.pose_files import write_kitti
from segslam.output.finished import read_run
from segslam.output.folder import write_metrics
from segslam.output.report.comparison import by_data, draw_runs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A run with ground truth and one without."""
    root = tmp_path_factory.mktemp("runs")
    folders = [make_run(root / "one").folder, make_run(root / "two", with_truth=False).folder]
    write_metrics(folders[0], {"ate_m": 0.25, "num_scans": 120, "num_loops_accepted": 4})
    write_metrics(folders[1], {"num_scans": 120, "num_loops_accepted": 7, "num_motions_rejected": 3})
    return folders


def test_runs_stand_side_by_side(runs: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert run("compare", *runs) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["one", "two"]
    assert next(line.split()[:2] for line in lines if "loops accepted" in line) == ["4", "7"]
    assert next(line.split()[:2] for line in lines if "trajectory error" in line) == ["0.25", "-"]
    assert run("compare", runs[0] / "log.mcap", runs[1]) == 0
    assert capsys.readouterr().out.splitlines() == lines


@pytest.mark.parametrize(("command", "indent"), [("compare", 30), ("eval", 12), ("info", 12)])
def test_long_meanings_are_wrapped_to_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: str, indent: int
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    make_run(Path("one"))
    make_run(Path("two"))
    write_metrics(Path("one"), {"map_thickness_m": 0.25, "num_motions_rejected": 3})
    assert run(command, *(["one", "two"] if command == "compare" else ["one"])) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any(line.startswith(" " * indent) for line in lines), "a second line of a meaning"


def test_figures_and_picture_of_several_runs(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plot = tmp_path / "both.png"
    assert run("compare", *runs, "--plot", plot, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["plot"] == str(plot)
    assert found["runs"]["two"]["num_loops_accepted"] == 7
    assert imread(plot).std() > 0.05


@pytest.mark.parametrize(
    ("second", "options", "expected"),
    [
        ("nowhere", (), "nowhere: no such file or folder"),
        (".", (), "metrics.json: no such file; give a folder made by `segslam map --out`"),
        ("one", (), "two or more different runs"),
        ("two", ("--plot", "both.doc"), "both.doc: unknown kind of figure"),
        ("two", ("--plot", "nowhere/both.png"), "there is no folder nowhere"),
    ],
)
def test_runs_that_cannot_be_compared_are_reported_in_one_line(
    runs: list[Path], capsys: pytest.CaptureFixture[str], second: str, options: tuple[str, ...], expected: str
) -> None:
    assert run("compare", runs[0], runs[0].parent / second, *options) == 2
    message = capsys.readouterr().err.strip()
    assert expected in message
    assert len(message.splitlines()) == 1


def test_runs_of_different_data_are_not_compared_with_the_truth_of_each_other(runs: list[Path], tmp_path: Path) -> None:
    one, two = (read_run(folder) for folder in runs)
    assert by_data({"one": one, "two": two}) == [["one", "two"]]
    assert one.reference is not None
    turned = replace(one.reference, T_world_lidar=one.reference.T_world_lidar * [[[2.0], [2.0], [1.0], [1.0]]])
    other = replace(two, dataset="another", reference=turned)
    assert by_data({"one": one, "other": other, "two": two}) == [["one", "two"], ["other"]]
    assert by_data({"two": two, "other": replace(two, dataset="another")}) == [["two"], ["other"]]
    later = replace(one.result.trajectory, stamp_ns=one.result.trajectory.stamp_ns + 1)
    shifted = replace(one, result=replace(one.result, trajectory=later))
    assert by_data({"one": one, "shifted": shifted}) == [["one"], ["shifted"]]
    draw_runs(tmp_path / "both.svg", {"one": one, "other": other})
    drawn = (tmp_path / "both.svg").read_text()
    assert drawn.count("ground truth") == 2
    assert ">another<" in drawn


def test_eval_draws_a_run_and_a_trajectory(runs: list[Path], tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    assert run("eval", made.folder, "--plot", tmp_path / "run.png", "--quiet") == 0
    for name, trajectory in (("truth", made.truth), ("estimate", made.result.odometry)):
        write_kitti(tmp_path / f"{name}.txt", trajectory.T_world_lidar)
    files = ("--estimate", tmp_path / "estimate.txt", "--reference", tmp_path / "truth.txt")
    assert run("eval", *files, "--plot", tmp_path / "files.svg", "--quiet") == 0
    assert imread(tmp_path / "run.png").std() > 0.05
    assert "<svg" in (tmp_path / "files.svg").read_text()


def test_the_doctor_names_versions_libraries_and_caches(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("doctor", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["packages"]["core"]["gtsam"]
    assert found["packages"]["viewer"].keys() == {"rerun-sdk"}
    assert set(found["libraries"]) == set(doctor.LIBRARIES)
    assert found["cores"] >= 1
    assert found["memory_gb"]["total"] > 0
    assert found["problems"] == []
    assert run("doctor") == 0
    assert "shared libraries:" in capsys.readouterr().out


def test_the_doctor_names_the_remedy_of_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    version = extras.installed_version
    monkeypatch.setattr(extras, "installed_version", lambda name: None if name == "kiss-icp" else version(name))
    monkeypatch.setattr(doctor, "_loads", lambda name: name != "libGL.so.1")
    assert run("doctor") == 1
    output = capsys.readouterr().out
    assert "pip install kiss-icp" in output
    assert "apt-get install libgl1" in output
