"""The imports and files of the package are those of docs/architecture.md."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "segslam"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
FILES = sorted(PACKAGE.rglob("*.py"))
LINES_TOLERANCE = 0.25


def _rooms() -> list[str]:
    """The rooms, top first: a line of the figure names one, then describes it."""
    return [line.split("/")[0] for line in PAGE.split("```")[1].strip("\n").splitlines()]


def _table(heading: str) -> list[list[str]]:
    section = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[2:]]


LEVEL = {name: level for level, name in enumerate(_rooms())}
LIBRARIES = {library: set(packages.split(", ")) for library, packages in _table("Libraries")}


def _part(file: Path) -> str:
    """The module or folder at the top of the package that a file belongs to."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def _imports(file: Path) -> list[str]:
    names: list[str] = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module] if node.module != "segslam" else [f"segslam.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return names


def test_the_figure_names_every_room_and_nothing_else_is_beside_them() -> None:
    there = {_part(file) for file in FILES} - {"__init__", "__main__"}
    assert there == set(LEVEL)


def test_the_tests_have_the_folders_of_the_package() -> None:
    packages = {file.parent.name for file in PACKAGE.glob("*/__init__.py")}
    folders = {file.parent.name for file in (ROOT / "tests").glob("*/test_*.py")}
    assert folders == packages | {"fuzz", "tools"}


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_module_imports_from_lower_layers_only(file: Path) -> None:
    part = _part(file)
    for name in _imports(file):
        top, _, rest = name.partition(".")
        if top != "segslam" or part in ("__init__", "__main__") or not rest:
            continue
        other = rest.split(".")[0]
        if other != part:
            assert LEVEL[part] < LEVEL[other], f"{part} imports {name}"


@pytest.mark.long
@pytest.mark.parametrize("library", LIBRARIES)
def test_library_is_imported_only_where_the_page_lists_it(library: str) -> None:
    importers = [
        file.relative_to(PACKAGE) for file in FILES if any(name.split(".")[0] == library for name in _imports(file))
    ]
    listed = [Path(name) for name in LIBRARIES[library]]
    assert all(any(file.is_relative_to(one) for one in listed) for file in importers)
    assert all(any(file.is_relative_to(one) for file in importers) for one in listed)


@pytest.mark.parametrize(("step", "code", "lines"), _table("One scan, from file to map"))
def test_walk_names_functions_and_lengths_as_they_are(step: str, code: str, lines: str) -> None:
    name, function = code.strip("`").split(": ")
    text = (PACKAGE / name).read_text()
    assert re.search(rf"^ *def {function}\(", text, re.MULTILINE), f"{step}: no {function} in {name}"
    length = text.count("\n")
    assert abs(length - int(lines)) <= LINES_TOLERANCE * length, f"{name} has {length} lines now"
