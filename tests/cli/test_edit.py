"""A person's word on loops."""

import json
from pathlib import Path

import pytest
from helpers.commands import run

from segslam.core.types import LoopClosure
from segslam.output.log import read_log

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("short_runs")]

QUICK = ("--set", "adjustment.max_minutes=0", "--quiet")


def _closures(log: Path) -> set[tuple[int, int]]:
    recorded = read_log(log)
    attempts = [attempt for step in recorded.steps() for attempt in step.attempts] + list(recorded.late_loops())
    outcomes = [attempt.outcome for attempt in attempts]
    return {(one.source_id, one.target_id) for one in outcomes if isinstance(one, LoopClosure)}


def test_a_forbidden_loop_is_not_closed_by_this_replay_and_later_ones(log: Path, tmp_path: Path) -> None:
    newer, older = max(_closures(log))
    assert run("edit", log, "--forbid", f"{older}:{newer}", "--out", tmp_path / "edited", *QUICK) == 0
    edited = tmp_path / "edited" / "log.mcap"
    assert (newer, older) not in _closures(edited)
    assert run("replay", edited, "--out", tmp_path / "again", *QUICK) == 0
    assert (newer, older) not in _closures(tmp_path / "again" / "log.mcap")
    assert run("edit", edited, "--add", f"{newer}:{older}", "--out", tmp_path / "back", *QUICK) == 0
    assert (newer, older) in _closures(tmp_path / "back" / "log.mcap")


@pytest.mark.long
def test_a_refined_run_keeps_the_edits_for_later_replays(log: Path, tmp_path: Path) -> None:
    newer, older = max(_closures(log))
    assert run("edit", log, "--forbid", f"{newer}:{older}", "--out", tmp_path / "edited", *QUICK) == 0
    minutes = ("--refine-minutes", 5, "--quiet")
    assert run("refine", tmp_path / "edited", "--out", tmp_path / "refined", *minutes) == 0
    assert run("replay", tmp_path / "refined", "--out", tmp_path / "again", *QUICK) == 0
    assert (newer, older) not in _closures(tmp_path / "again" / "log.mcap")


def test_an_added_loop_is_registered_though_no_search_proposes_it(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    newer, older = max(_closures(log))
    none = ["--set", "proximity.base_radius_m=0.001", *QUICK[:2]]
    assert run("edit", log, "--add", f"{newer}:{older}", "--out", tmp_path / "edited", *none) == 0
    assert f"added {newer}:{older}: accepted, probability" in capsys.readouterr().err
    assert _closures(tmp_path / "edited" / "log.mcap") == {(newer, older)}


def test_wrong_pairs_are_refused_in_one_line(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        ([], "nothing to edit"),
        (["--forbid", "5000:3"], "5000:3: "),
        (["--add", "a:b"], "--add a:b: give two keyframes"),
        (["--add", "4:1", "--forbid", "1:4"], "both forbidden and added"),
        (["--forbid", "1:1"], "1:1: give two keyframes"),
    ):
        assert run("edit", log, *arguments, "--out", tmp_path / "no") == 2
        assert message in (shown := capsys.readouterr().err)
        assert "forbidden all the same" not in shown
    assert not (tmp_path / "no").exists()


def test_forbidding_a_pair_that_is_no_loop_is_reported(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    newer, older = max(_closures(log))
    arguments = ["--forbid", "1:0", "--forbid", f"{newer}:{older}", "--set", "adjustment.max_minutes=0"]
    assert run("edit", log, *arguments, "--out", tmp_path / "edited") == 0
    shown = capsys.readouterr().err
    assert "1:0: " in shown
    assert f"{newer}:{older}: " not in shown


def test_info_shows_data_state_settings_and_files(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert run("replay", log, "--out", out, "--set", "verify.max_false_share=0.01", "--quiet") == 0
    assert run("info", out, "--json", "--quiet") == 0
    found = json.loads(capsys.readouterr().out)
    metrics = json.loads((out / "metrics.json").read_text())
    assert found["state"] == "finished"
    assert found["num_steps"] == metrics["num_scans"]
    assert found["figures"]["ate_m"] == metrics["ate_m"]
    assert found["changed_settings"]["verify.max_false_share"] == "0.01"
    assert found["files"]["log.mcap"] == (out / "log.mcap").stat().st_size
    assert run("info", out) == 0
    shown = capsys.readouterr().out
    size = f"{(out / 'config.yaml').stat().st_size / 1e3:.1f} kB  config.yaml"
    for text in ("finished", "verify.max_false_share=0.01", "loops accepted", "breaks: ", "log.mcap", size):
        assert text in shown


def test_info_of_an_interrupted_run_names_the_command_that_continues(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cut").mkdir()
    whole = log.read_bytes()
    (tmp_path / "cut" / "log.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    assert run("info", tmp_path / "cut") == 0
    shown = capsys.readouterr().out
    assert "interrupted" in shown
    assert f"segslam resume {tmp_path / 'cut'}" in shown
