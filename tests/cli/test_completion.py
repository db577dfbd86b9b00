"""Completion of values in the shell."""

from pathlib import Path

import pytest

from segslam.bench.experiments.method_settings import METHOD_NAMES
from segslam.cli import completion
from segslam.cli.completion import datasets, labels_or_files, one_of, presets, settings, simulation_settings
from segslam.core.config import Config


def test_keys_of_settings_and_their_values_are_completed() -> None:
    assert settings("verify.max_fal") == ["verify.max_false_share="]
    assert len(settings("")) == sum(len(type(section).model_fields) for _, section in Config())
    assert settings("graph.final=") == ["graph.final=none", "graph.final=gnc", "graph.final=consistent"]
    assert settings("verify.max_false_share=") == []
    assert settings("nothing") == []
    assert simulation_settings("world.ca") == ["world.cars="]


def test_names_are_completed() -> None:
    assert presets("") == ["auto", "driving", "campus", "indoor"]
    assert one_of(*METHOD_NAMES)("segregator") == ["segregator", "segregator-c2f"]
    assert "kitti" in datasets("k")


def test_labels_are_words_or_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "geo.label").touch()
    (tmp_path / "geo").mkdir()
    monkeypatch.chdir(tmp_path)
    assert set(labels_or_files("geo")) == {
        "geometric",
        "geo.label",
        "geo/",
    }
    assert labels_or_files("missing/") == []


def test_the_shell_is_offered_the_values(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from helpers.commands import run

    monkeypatch.setenv("_SEGSLAM_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "segslam map data --preset ca")
    monkeypatch.setenv("COMP_CWORD", "4")
    run()
    assert capsys.readouterr().out.split() == ["campus"]
    assert completion.SENSORS[0] == "hdl64"
