"""A grid of settings by replay."""

import csv
import json
import shutil
from pathlib import Path

import pytest
from helpers.commands import run

from segslam.cli.compare import grid_of
from segslam.core.errors import SegslamError
from segslam.output.finished import read_run

pytestmark = pytest.mark.usefixtures("short_runs")


def test_all_combinations_are_made() -> None:
    assert grid_of(["a.b=1,2", "c.d=x"]) == {"a.b=1 c.d=x": ["a.b=1", "c.d=x"], "a.b=2 c.d=x": ["a.b=2", "c.d=x"]}
    for empty in ("a.b", "a.b=", "a.b=,"):
        with pytest.raises(SegslamError, match="give values"):
            grid_of([empty])
    with pytest.raises(SegslamError, match=r"--set a\.b: given twice; give all its values at once"):
        grid_of(["a.b=1", "c.d=x", "a.b=2"])


@pytest.mark.long
def test_a_sweep_replays_each_value_once_and_tables_it(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sweep"
    given = ["sweep", log, "--set", "verify.max_false_share=0.2,1e-300", "--out", out, "--csv", out / "t.csv"]
    assert run(*given, "--json", "--quiet") == 0
    rows = json.loads(capsys.readouterr().out)["runs"]
    loose, strict = rows["verify.max_false_share=0.2"], rows["verify.max_false_share=1e-300"]
    assert loose["num_loops_accepted"] > strict["num_loops_accepted"]
    assert read_run(out / "verify.max_false_share=1e-300").config.verify.max_false_share == 1e-300
    names = [row["name"] for row in csv.DictReader((out / "t.csv").read_text().splitlines())]
    assert names == list(rows)
    before = (out / "verify.max_false_share=0.2" / "log.mcap").stat().st_mtime_ns
    assert run(*given, "--overwrite") == 0
    assert (out / "verify.max_false_share=0.2" / "log.mcap").stat().st_mtime_ns == before
    assert "verify.max_false_share=1e-300" in capsys.readouterr().out
    other = shutil.copy(log, tmp_path / "other.mcap")
    assert run("sweep", other, *given[2:], "--overwrite") == 2
    assert "replays of another log" in capsys.readouterr().err


def test_a_wrong_setting_or_table_is_reported_before_anything_is_replayed(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for setting, message in (("verify.nothing=1,2", "unknown key"), ("keyframes.voxel_m=0.3,0.4", "a replay uses")):
        assert run("sweep", log, "--set", setting, "--out", tmp_path / "no", "-q") == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
    setting = "verify.max_false_share=0.2"
    assert run("sweep", log, "--set", setting, "--out", tmp_path / "no", "--csv", tmp_path / "nowhere" / "t.csv") == 2
    assert "there is no folder" in capsys.readouterr().err
    assert not list((tmp_path / "no").iterdir())
    assert run("sweep", log, "--set", setting, "--out", log) == 2
    assert f"{log}: cannot be written (File exists); give another with --out" in capsys.readouterr().err
