import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import round_drive

from segslam.core import geometry
from segslam.labels.encodings import RAW_OF_LABEL


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Two scans of one street as .npy, with raw labels."""
    folder = tmp_path_factory.mktemp("scans")
    scans, _ = round_drive()
    paths: dict[str, Path] = {}
    for name, scan in (("source", scans[3]), ("target", scans[0])):
        paths[name] = folder / f"{name}.npy"
        np.save(paths[name], scan.points)
        paths[f"{name}_labels"] = folder / f"{name}.label"
        RAW_OF_LABEL[scan.labels].astype("<u4").tofile(paths[f"{name}_labels"])
    return paths


@pytest.mark.parametrize("refine", [True, False])
def test_register_prints_the_pose_as_json(
    files: dict[str, Path], capsys: pytest.CaptureFixture[str], refine: bool
) -> None:
    labels = ["--labels", files["source_labels"], files["target_labels"]]
    options = [] if refine else ["--no-refine"]
    assert run("register", files["source"], files["target"], *labels, *options, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["accepted"]
    assert figures["reason"] is None
    _, truth = round_drive()
    T_target_source = geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[3]
    found = np.array(figures["T_target_source"]).reshape(4, 4)
    assert geometry.distance(geometry.inverse(T_target_source) @ found) < (0.05 if refine else 0.3)
    assert {"describe_source", "describe_target", "match"} <= set(figures["seconds"])
    assert ("refine" in figures["seconds"]) == refine
    assert figures["num_inliers"] >= 3
    assert figures["overlap"] > 0.5 if refine else figures["overlap"] is None


@pytest.mark.parametrize("labels", ["geometric", "none"])
def test_a_numbering_is_refused_without_label_files(
    labels: str, files: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("register", files["source"], files["target"], "--labels", labels, "--encoding", "raw") == 2
    assert f"--encoding raw: only label files have one; omit it with --labels {labels}" in capsys.readouterr().err
    assert run("locate", "nowhere", files["source"], "--labels", labels, "--encoding", "raw") == 2
    assert f"--encoding raw: only label files have one; omit it with --labels {labels}" in capsys.readouterr().err


def test_a_rejection_has_a_reason_one_line_and_exit_status_1(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "wall.npy", np.column_stack([np.full(500, 5.0), np.linspace(-9, 9, 500), np.zeros(500)]))
    assert run("register", tmp_path / "wall.npy", files["target"], "--json", "--quiet") == 1
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith("rejected: ")
    figures = json.loads(printed.out)
    assert not figures["accepted"]
    assert figures["reason"]
    assert figures["T_target_source"] is None


def test_labels_are_taken_in_one_option_or_in_two(files: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    """Swapped labels: the wrong numbers are detected only if both files are read."""
    labels = files["target_labels"], files["source_labels"]
    for given in (["--labels", *labels], ["--labels", labels[0], "--labels", labels[1]]):
        assert run("register", files["source"], files["target"], *given) == 2
        assert "labels for" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["missing.bin", "{target}"], "missing.bin"),
        (["{source}", "{target}", "--method", "magic"], "magic"),
        (["{source}", "{target}", "--labels", "{source_labels}"], "two .label files"),
        (["{source}", "{target}", "--labels", "{target_labels}", "{source_labels}"], "labels for"),
        (["{source}", "{target}", "--labels", "a.label", "b.label"], "a.label: no such file"),
        (["{source}", "{target}", "--dataset", "kitty"], "kitty"),
        (["{source_labels}", "{target}"], ".label"),
    ],
)
def test_bad_input_is_named_in_one_line(
    files: dict[str, Path], capsys: pytest.CaptureFixture[str], arguments: list[str], expected: str
) -> None:
    assert run("register", *(argument.format(**files) for argument in arguments)) == 2
    message = capsys.readouterr().err.strip()
    assert expected in message
    assert len(message.splitlines()) == 1


@pytest.mark.data
def test_the_real_pair_is_found_with_predicted_labels(
    data_dir: Path, real_pairs, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = data_dir / "kitti" / "sequences" / "00"
    names = ("000000", "004413")
    scans = [folder / "velodyne" / f"{name}.bin" for name in names]
    labels = [folder / "predicted_labels" / f"{name}.label" for name in names]
    pair = next(pair for pair in real_pairs.pairs if (pair.source, pair.target) == (0, 4413))
    for options, metres, degrees in ((["--no-refine"], 0.3, 1.0), ([], 0.05, 0.2)):
        assert run("register", *scans, "--dataset", "kitti", "--labels", *labels, *options, "--json") == 0
        found = np.array(json.loads(capsys.readouterr().out)["T_target_source"]).reshape(4, 4)
        error = geometry.inverse(pair.T_target_source) @ found
        assert geometry.distance(error) < metres
        assert np.degrees(geometry.angle(error)) < degrees
