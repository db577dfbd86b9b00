"""Messages about missing optional packages contain a command that installs them."""

import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from segslam.core.extras import how_to_install, requirements
from segslam.core.types import SegslamError
from segslam.gnss import Origin
from segslam.output.map import write
from segslam.scans.decoding import CLOUD, decoder

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def _declared(extra: str) -> list[Requirement]:
    return [Requirement(line) for line in PROJECT["optional-dependencies"][extra]]


@pytest.mark.parametrize("extra", sorted(set(PROJECT["optional-dependencies"]) - {"dev"}))
def test_the_command_names_the_packages_of_the_extra_in_the_versions_that_were_tested(extra: str) -> None:
    """Not segslam's own extra: PyPI has no segslam to take it from."""
    output = how_to_install(extra)
    assert output.startswith("pip install ")
    assert "segslam" not in output
    packages = {found.name: found.specifier for found in map(Requirement, output.replace("'", "").split()[2:])}
    assert packages == {wanted.name: wanted.specifier for wanted in _declared(extra)}


def test_requirements_are_those_of_the_project() -> None:
    core = {found.package for found in requirements() if found.extra is None}
    assert core == {Requirement(line).name for line in PROJECT["dependencies"]}


def test_las_and_ros_messages_have_the_install_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(write, "find_spec", lambda _: None)
    with pytest.raises(SegslamError, match=r"pip install 'laspy<.*' 'lazrs<"):
        write.check_names([tmp_path / "map.laz"])
    with monkeypatch.context() as patch:
        patch.setattr(write, "find_spec", lambda name: None if name == "pyproj" else object())
        with pytest.raises(SegslamError, match=r"pip install 'pyproj<.*' 'rasterio<"):
            write.check_names([tmp_path / "map.laz"], origin=Origin(48.98, 8.39, 115.0))
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(ImportError, match="pip install 'rosbags<"):
        decoder(CLOUD, is_ros1=False)
