"""Runs that cannot be merged or used for localisation: one line, exit status 2, and no files."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.commands import run
from helpers.finished_run import make_run


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "good").folder


def _without_log(folder: Path) -> None:
    folder.mkdir()


def _unfinished(folder: Path) -> None:
    make_run(folder, finished=False)


def _damaged(folder: Path) -> None:
    make_run(folder)
    log = folder / "log.mcap"
    size = log.stat().st_size
    with log.open("r+b") as stream:
        stream.seek(size // 3)
        stream.write(b"\xff" * (size // 3))


def _without_figures(folder: Path) -> None:
    make_run(folder)
    (folder / "metrics.json").unlink()


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (_without_log, "log.mcap"),
        (_unfinished, "did not finish"),
        (_damaged, "damaged"),
        (_without_figures, "metrics.json"),
    ],
)
def test_a_run_that_is_not_whole_is_refused_by_name(
    good: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    make: Callable[[Path], None],
    complaint: str,
) -> None:
    bad, out = tmp_path / "bad", tmp_path / "out"
    make(bad)
    for arguments in (("merge", good, bad), ("merge", bad, good), ("localise", bad, tmp_path)):
        assert run(*arguments, "--out", out, "--quiet") == 2
        output = capsys.readouterr().err.strip().splitlines()
        assert len(output) == 1, output
        assert str(bad) in output[0]
        assert complaint in output[0]
        assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("merge", "{good}"), "two or more"),
        (("merge", "{good}", "{good}/log.mcap"), "given twice"),
        (("merge", "{good}", "nowhere"), "nowhere: no such file"),
        (("merge", "{good}", "{good}", "--set", "graph.colour=red"), "unknown key graph.colour"),
        (("localise", "nowhere", "{good}"), "nowhere: no such file"),
        (("localise", "{good}", "nowhere"), "nowhere: no such file"),
    ],
)
def test_bad_usage_is_reported_in_one_line(
    good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], complaint: str
) -> None:
    given = [argument.format(good=good) for argument in arguments]
    assert run(*given, "--out", tmp_path / "out", "--quiet") == 2
    output = capsys.readouterr().err.strip().splitlines()
    assert len(output) == 1, output
    assert complaint in output[0]
    assert not (tmp_path / "out").exists()


def test_a_setting_that_would_have_no_effect_in_a_merged_run_is_refused(
    good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`locate` would correct scans by an angle by which those of the map were not corrected."""
    other, setting = shutil.copytree(good, tmp_path / "other"), "sensor.vertical_angle_deg=3"
    assert run("merge", good, other, "--out", tmp_path / "out", "--quiet", "--set", setting) == 2
    assert "sensor.vertical_angle_deg: a merged run uses the keyframes of" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_is_in_the_new_folder_stays(good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = shutil.copytree(good, tmp_path / "other")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("kept")
    assert run("merge", good, other, "--out", tmp_path / "out", "--quiet") == 2
    assert "not empty" in capsys.readouterr().err
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["mine.txt"]
