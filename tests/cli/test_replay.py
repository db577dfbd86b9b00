import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.commands import run
from helpers.drives import SLAM_CONFIG
from helpers.made_logs import write_log

from segslam.core.types import LoopAttempt, LoopClosure
from segslam.output.finished import plain_name
from segslam.output.log import read_log
from segslam.output.words import FIGURES
from segslam.verification.score import shipped

pytestmark = pytest.mark.usefixtures("short_runs")


def _attempts(log: Path) -> list[LoopAttempt]:
    return [attempt for step in read_log(log).steps() for attempt in step.attempts]


def _pair_and_outcome(attempt: LoopAttempt) -> tuple[Any, ...]:
    """All of an attempt that does not depend on the clock."""
    pair = (attempt.candidate.source_id, attempt.candidate.target_id)
    if isinstance(attempt.outcome, LoopClosure):
        return (*pair, attempt.outcome.T_target_source.tolist(), attempt.outcome.alignment.overlap)
    return (*pair, attempt.outcome)


@pytest.mark.long
def test_a_replay_with_the_same_settings_repeats_the_run(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "again"
    assert run("replay", log, "--out", out, "--json", "--quiet") == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics == json.loads((out / "metrics.json").read_text())
    assert (metrics["num_loops_won"], metrics["num_loops_lost"]) == (0, 0)
    assert metrics["num_loops_accepted"] > 0
    assert metrics["ate_m"] == pytest.approx(metrics["recorded_ate_m"], abs=1e-9)
    unnamed = {key for key, value in metrics.items() if value is not None and plain_name(key) not in FIGURES}
    assert unnamed == {"stage_ms"}
    before, after = ([_pair_and_outcome(attempt) for attempt in _attempts(path)] for path in (log, out / "log.mcap"))
    assert before == after
    poses_before, poses_after = (read_log(path).result()[1] for path in (log, out / "log.mcap"))
    np.testing.assert_array_equal(poses_before.scan_index, poses_after.scan_index)
    np.testing.assert_allclose(poses_before.T_world_lidar, poses_after.T_world_lidar, rtol=0, atol=1e-9)


@pytest.mark.long
def test_other_settings_change_the_loops_and_the_change_is_printed(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odds = [sum(a.outcome.alignment.evidence.values()) for a in _attempts(log) if isinstance(a.outcome, LoopClosure)]
    share = 1.0 / (1.0 + math.exp(float(np.median(odds)) + shipped().margin + 1e-6))
    strict = tmp_path / "strict.yaml"
    strict.write_text(yaml.safe_dump({"verify": {"max_false_share": share}}))
    out = tmp_path / "strict"
    assert run("replay", log, "--out", out, "--config", strict) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["num_loops_lost"] > 0
    won = metrics["num_loops_won"]
    output = f"{won} loop{'' if won == 1 else 's'} more, {metrics['num_loops_lost']} fewer"
    assert output in capsys.readouterr().err
    settings = read_log(out / "log.mcap").config
    assert settings.verify.max_false_share == pytest.approx(share)
    assert settings.proximity == SLAM_CONFIG.proximity, "settings of the log that were not changed remain"


@pytest.mark.parametrize("change", ["keyframes.voxel_m=0.31", "health.check=false"])
def test_a_setting_that_acts_before_the_keyframes_is_refused_and_nothing_written(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str
) -> None:
    out = tmp_path / "out"
    assert run("replay", log, "--out", out, "--set", change) == 2
    assert f"{change.split('=')[0]}: a replay uses the keyframes of" in capsys.readouterr().err
    assert not out.exists()


def test_a_cut_log_is_replayed_up_to_the_cut(log: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size // 3])
    num_steps = len(list(read_log(cut).steps()))
    assert run("replay", cut, "--out", tmp_path / "out", "--quiet") == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["num_scans"] == num_steps > 0
    assert "recorded_ate_m" not in metrics


def test_a_log_without_a_step_is_refused_with_the_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_log(tmp_path / "log.mcap", [])
    for command in (("replay", log), ("refine", log), ("edit", log, "--forbid", "1:0")):
        assert run(*command, "--out", tmp_path / "run", "--quiet") == 2
        assert "log.mcap: has no complete step; continue it (segslam resume), or map again" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["log.mcap"]


def test_a_file_that_is_not_a_log_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "log.mcap").write_text("scans")
    assert run("replay", tmp_path / "log.mcap", "--out", tmp_path / "out") == 2
    assert "give the log.mcap of a run" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
