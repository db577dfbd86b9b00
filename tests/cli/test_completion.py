"""Completion of values in the shell."""

from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.commands import run

from segslam.cli.completion import settings
from segslam.core.config import Config

Offered = Callable[[str], list[str]]


@pytest.fixture
def offered(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Offered:
    """What bash shows for the last word of a command line."""

    def of(line: str) -> list[str]:
        monkeypatch.setenv("_SEGSLAM_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", f"segslam {line}")
        monkeypatch.setenv("COMP_CWORD", str(len(line.split(" "))))
        run()
        return capsys.readouterr().out.split()

    return of


def test_keys_of_settings_and_their_values_are_completed(offered: Offered) -> None:
    assert offered("map data --set verify.max_fal") == ["verify.max_false_share="]
    assert len(settings("")) == sum(len(type(section).model_fields) for _, section in Config())
    values = ["graph.final=none", "graph.final=gnc", "graph.final=consistent"]
    assert offered("map data --set graph.final=") == values
    assert offered("map data --set verify.max_false_share=") == []
    assert offered("map data --set nothing") == []
    assert offered("simulate out --set world.ca") == ["world.cars="]


def test_names_are_completed(offered: Offered) -> None:
    assert offered("map data --preset ") == ["auto", "driving", "campus", "indoor"]
    assert offered("map data --preset ca") == ["campus"]
    assert offered("register a b --method segregator") == ["segregator", "segregator-c2f"]
    assert offered("simulate out --sensor v") == ["vlp16"]
    assert "kitti" in offered("map data --dataset k")


def test_labels_are_words_or_paths(offered: Offered, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "geo.label").touch()
    (tmp_path / "geo").mkdir()
    monkeypatch.chdir(tmp_path)
    assert set(offered("map data --labels geo")) == {"geometric", "geo.label", "geo/"}
    assert offered("map data --labels missing/") == []


def test_paths_are_offered_as_they_are_begun(offered: Offered, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine" / "labels").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for begun in ("./mi", "~/mi", f"{tmp_path}/mi"):
        assert offered(f"map data --labels {begun}") == [f"{begun}ne/"]
    assert offered("map data --labels ~/mine/") == ["~/mine/labels/"]
    assert offered("map data --labels ~nosuch/") == []
