"""The look at the surroundings that chooses the settings of a live run."""

from pathlib import Path

import pytest
from helpers.commands import run
from helpers.live_command import LiveCommand, record
from helpers.near_source import NearSource, ring

from segslam.cli.checks import live_configs
from segslam.cli.options import Settings
from segslam.core.config import load_config
from segslam.core.types import BadScan, Scan
from segslam.run.live.front import Front
from segslam.scans.presets import preset


@pytest.mark.long
def test_the_first_scan_with_a_pose_chooses_the_preset_of_a_live_run() -> None:
    with Front(NearSource(), live_configs("auto", Settings()), tell=print) as front:
        front.wait_until_ready()
        chosen = front.wait_until_chosen()
        placed = list(front)
    assert chosen is not None
    assert (chosen.preset, chosen.extent_m) == ("indoor", pytest.approx(6.0, abs=0.1))
    assert [isinstance(one.tracked, BadScan) for one in placed] == [True, False, False]


def test_settings_override_each_preset_that_may_be_chosen() -> None:
    configs = live_configs("auto", Settings(settings=["odometry.voxel_size_m=0.7"]))
    assert {config.odometry.voxel_size_m for config in configs.values()} == {0.7}
    assert configs["campus"].proximity == preset("campus").proximity
    assert {name: config == preset("campus") for name, config in live_configs("campus", Settings()).items()} == {
        "driving": True,
        "campus": True,
        "indoor": True,
    }


def test_an_unknown_preset_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("live", tmp_path, "--out", tmp_path / "run", "--preset", "moon") == 2
    assert "unknown preset; known: auto, driving, campus, indoor" in capsys.readouterr().err


@pytest.mark.slow
def test_a_live_run_that_begins_with_an_empty_folder_has_the_settings_for_its_scans(tmp_path: Path) -> None:
    folder, made = tmp_path / "scans", tmp_path / "run"
    folder.mkdir()
    with LiveCommand(folder, "--out", made, "--idle", "2") as command:
        command.wait_for("waiting for scans")
        record(folder, [Scan(ring(6.0), number, number) for number in range(4)], every_s=0.3)
        status, _ = command.ended()
    assert status == 0, command.output
    assert "surfaces are near (median range 6 m): using --preset indoor" in command.output
    assert load_config(made / "config.yaml").odometry == preset("indoor").odometry
