"""A wheel built from the sources, installed into a bare environment, works there."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]


def _run(*words: object, folder: Path) -> str:
    done = subprocess.run([str(word) for word in words], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout + done.stderr


def test_the_conda_recipe_has_the_version_and_the_dependencies_of_the_project() -> None:
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = whole["project"]
    recipe = yaml.safe_load((ROOT / "conda" / "recipe" / "recipe.yaml").read_text())
    assert (recipe["package"]["version"], recipe["about"]["summary"]) == (project["version"], project["description"])
    python, *dependencies = recipe["requirements"]["run"]
    assert python == f"python {project['requires-python']}"
    assert [text.replace(" ", "") for text in dependencies] == project["dependencies"]
    assert all(re.fullmatch(r"[\w-]+ \S+", text) for text in dependencies)
    built = [text.replace(" ", "") for text in recipe["requirements"]["host"]]
    assert set(whole["build-system"]["requires"]) <= set(built)
    [(name, target)] = project["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == [f"{name} = {target}"]


@pytest.mark.slow
def test_a_wheel_in_a_bare_environment_maps_a_simulated_drive(tmp_path: Path) -> None:
    """All dependencies come from the package registry; nothing of the sources is visible."""
    _run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, ROOT, folder=tmp_path)
    (wheel,) = tmp_path.glob("segslam-*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {"segslam/py.typed", "segslam/output/words.toml"} <= names
    assert {f"segslam/output/report/{name}" for name in ("interactive.js", "style.css")} <= names
    assert not any(name.startswith(("tests/", "tools/", "docs/")) for name in names)
    _run(sys.executable, "-m", "venv", "bare", folder=tmp_path)
    scripts = tmp_path / "bare" / "bin"
    _run(scripts / "pip", "install", "-q", wheel, folder=tmp_path)
    segslam = scripts / "segslam"
    assert _run(segslam, "--version", folder=tmp_path).startswith("segslam ")
    _run(segslam, "simulate", "streets", "--sensor", "vlp16", "--frames", "5", "-q", folder=tmp_path)
    _run(segslam, "map", "streets", "--out", "run", "-q", folder=tmp_path)
    assert (tmp_path / "run" / "report.html").stat().st_size > 1_000_000
