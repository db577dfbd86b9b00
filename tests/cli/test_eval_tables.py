"""`eval` with other alignments, of folders, and its tables as CSV and LaTeX."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import drifting, round_drive
from helpers.finished_run import make_run

from segslam.cli.tables import as_text
from segslam.core.pose_files import write_kitti
from segslam.output.accuracy import scores
from segslam.output.report import figures
from segslam.output.words import COLUMNS

TRUTH = round_drive()[1]
ESTIMATE = drifting(TRUTH).T_world_lidar


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    estimates, references = tmp_path / "made", tmp_path / "true"
    (estimates / "02").mkdir(parents=True)
    references.mkdir()
    for name in ("00", "01", "02"):
        write_kitti(references / f"{name}.txt", TRUTH.T_world_lidar)
    write_kitti(estimates / "00.txt", ESTIMATE)
    write_kitti(estimates / "02" / "poses_kitti.txt", TRUTH.T_world_lidar)
    return estimates, references


def test_two_folders_are_compared_drive_by_drive(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimates, references = folders
    table, latex = tmp_path / "all.csv", tmp_path / "all.tex"
    given = ["eval", "--estimate", estimates, "--reference", references, "--up", "z", "--csv", table, "--latex", latex]
    assert run(*given) == 0
    out, err = capsys.readouterr()
    shown = out.splitlines()
    assert [line.split()[0] for line in shown[1:]] == ["00", "02", "mean"]
    assert max(map(len, shown)) <= 80
    assert err.count("upward axis z") == 1
    rows = {row["name"]: row for row in csv.DictReader(table.read_text().splitlines())}
    expected = scores(ESTIMATE, TRUTH.T_world_lidar)
    for key in ("ate_m", "ate_mean_m", "ate_median_m", "ate_max_m"):
        assert float(rows["00"][key]) == pytest.approx(expected[key], rel=1e-6)
        assert float(rows["mean"][key]) == pytest.approx(expected[key] / 2, abs=1e-6)
    text = latex.read_text()
    assert text.startswith(r"\begin{tabular}{l")
    assert f"00 & {expected['ate_m']:.3f} & " in text
    assert r"\%" in text or "KITTI" not in text
    assert run(*given) == 2, "tables are not replaced"
    assert "--overwrite" in capsys.readouterr().err


def test_a_table_does_not_replace_the_poses_that_are_compared(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference = tmp_path / "truth.csv"
    (folders[1] / "00.txt").rename(reference)
    poses = reference.read_text()
    given = ["eval", "--estimate", folders[0] / "00.txt", "--reference", reference, "--csv", reference, "--overwrite"]
    assert run(*given) == 2
    assert "is an input of this command" in capsys.readouterr().err
    assert reference.read_text() == poses


def test_folders_without_a_common_drive_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("eval", "--estimate", tmp_path, "--reference", tmp_path, "-q") == 2
    assert "no drive has poses here and in" in capsys.readouterr().err


@pytest.mark.parametrize("align", ["se3", "sim3", "first", "none"])
def test_the_alignment_is_chosen_and_only_the_rigid_one_is_kept_with_a_run(
    align: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = make_run(tmp_path / "run")
    before = json.loads((made.folder / "metrics.json").read_text())
    assert run("eval", made.folder, "--align", align, "--rpe-distance", "50", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    expected = scores(made.result.trajectory.T_world_lidar, made.truth.T_world_lidar, align=align, rpe_distance_m=50.0)  # type: ignore[arg-type]
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, abs=1e-6), key
    odometry = scores(made.result.odometry.T_world_lidar, made.truth.T_world_lidar, align=align)  # type: ignore[arg-type]
    assert found["odometry_ate_m"] == pytest.approx(odometry["ate_m"], abs=1e-6)
    after = json.loads((made.folder / "metrics.json").read_text())
    assert "rpe_over_distance_m" in found
    assert "ate_max_m" not in after
    assert (after == before) == (align != "se3")


def test_the_alignment_is_named_and_the_picture_has_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, drawn = make_run(tmp_path / "run"), []
    plot_error = figures.plot_error
    monkeypatch.setattr(figures, "plot_error", lambda *given: (drawn.append(given[2]), plot_error(*given)))
    picture = tmp_path / "scored.png"
    assert run("eval", made.folder, "--align", "none", "--plot", picture) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "absolute trajectory error without alignment, rms (m)" in words
    assert "after alignment" not in words
    assert run("eval", made.folder, "--rpe-distance", 9000) == 0
    assert "--rpe-distance 9000: no drive is that long" in capsys.readouterr().err
    np.testing.assert_allclose(drawn[0], made.result.trajectory.T_world_lidar, atol=1e-6)
    assert picture.exists()


def test_compare_writes_its_table(tmp_path: Path) -> None:
    first, second = (make_run(tmp_path / name).folder for name in ("a", "b_c"))
    assert run("compare", first, second, "--csv", tmp_path / "t.csv", "--latex", tmp_path / "t.tex", "-q") == 0
    assert [row["name"] for row in csv.DictReader((tmp_path / "t.csv").read_text().splitlines())] == ["a", "b_c"]
    assert r"b\_c & " in (tmp_path / "t.tex").read_text()


def test_columns_that_do_not_fit_the_terminal_follow_below(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    row = dict.fromkeys(COLUMNS, 1.25)
    text = as_text({"graph.final=consistent": row, "graph.final=none": row})
    assert max(map(len, text.splitlines())) <= 80
    assert all(title in text for title in COLUMNS.values())
    assert text.count("graph.final=none") == text.count("\n\n") + 1 > 1
