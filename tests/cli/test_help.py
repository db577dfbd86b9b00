"""The help of the command line: groups, widths, names of values, aliases."""

import re

import pytest
from helpers.commands import all_commands, run
from typer.main import get_command

from segslam import cli
from segslam.cli import commands
from segslam.cli.commands import ALIASES


def _shown(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> str:
    monkeypatch.setenv("COLUMNS", "80")
    assert run(*arguments, "--help") == 0
    return capsys.readouterr().out


def test_commands_are_in_groups_with_map_first_and_whole_lines_in_80_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = _shown(capsys, monkeypatch)
    listed = text[text.index("Map:") :]
    assert re.findall(r"^(\w[\w ]*):$", listed, re.MULTILINE) == list(commands.GROUPS)
    assert re.findall(r"^  ([\w-]+) ", listed, re.MULTILINE)[0] == "map"
    names = re.findall(r"^  ([\w-]+) ", listed, re.MULTILINE)
    assert sorted(names) == sorted([*(name for group in commands.GROUPS.values() for name in group), "bench"])
    assert "..." not in listed, "no line is cut"
    assert max(map(len, text.splitlines())) <= 80


def test_no_help_names_types_of_python(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    commands.add(cli.app)
    for name, _ in all_commands(get_command(cli.app)):
        text = _shown(capsys, monkeypatch, *name.split())
        found = re.search(r"<(path|str|int|float|list|bool)\b|list\[|int range|float range|\{[A-Z]", text)
        assert found is None, f"{name}: {found}"
        assert max(map(len, text.splitlines())) <= 80, name


@pytest.mark.parametrize("alias", sorted(ALIASES))
def test_aliases_are_the_same_commands(
    alias: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    same = _shown(capsys, monkeypatch, ALIASES[alias])
    assert _shown(capsys, monkeypatch, alias).replace(f"segslam {alias}", f"segslam {ALIASES[alias]}") == same
