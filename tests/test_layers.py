"""The imports and files of the package are those of docs/architecture.md."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "segslam"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
FILES = sorted(PACKAGE.rglob("*.py"))
SAME_LAYER = {("config", "types")}
"""Importer and imported: the settings name the classes of `types`."""
LINES_TOLERANCE = 0.25


def _layers() -> list[list[str]]:
    """The names of each layer, top first: words separated by two spaces, then a description after four or more."""
    figure = PAGE.split("```")[1].strip("\n")
    return [re.split(r" {2,3}", re.split(r" {4,}", line)[0].strip()) for line in figure.splitlines()]


def _table(heading: str) -> list[list[str]]:
    section = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[2:]]


LEVEL = {name.rstrip("/"): level for level, names in enumerate(_layers()) for name in names}
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


def test_the_figure_names_every_module_and_folder() -> None:
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
        if other != part and (part, other) not in SAME_LAYER:
            assert LEVEL[part] < LEVEL[other], f"{part} imports {name}"


@pytest.mark.parametrize("library", LIBRARIES)
def test_library_is_imported_only_where_the_page_lists_it(library: str) -> None:
    importers = {_part(file) for file in FILES if any(name.split(".")[0] == library for name in _imports(file))}
    assert importers == LIBRARIES[library]


@pytest.mark.parametrize(("step", "code", "lines"), _table("One scan, from file to map"))
def test_walk_names_functions_and_lengths_as_they_are(step: str, code: str, lines: str) -> None:
    name, function = code.strip("`").split(": ")
    text = (PACKAGE / name).read_text()
    assert re.search(rf"^ *def {function}\(", text, re.MULTILINE), f"{step}: no {function} in {name}"
    length = text.count("\n")
    assert abs(length - int(lines)) <= LINES_TOLERANCE * length, f"{name} has {length} lines now"
