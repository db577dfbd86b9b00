"""Compiled functions: which there are, that they are compiled where that is wanted, and where their code is kept."""

import os
from pathlib import Path

import pytest

from segslam.core import kernels

PACKAGE = Path(kernels.__file__).parents[1]


def _names(files: list[Path]) -> set[str]:
    return {".".join(file.relative_to(PACKAGE).with_suffix("").parts) for file in files}


def test_every_module_with_kernels_is_built() -> None:
    files = [file for file in PACKAGE.rglob("*.py") if "\n@kernel(" in file.read_text() and file.name != "kernels.py"]
    assert _names(files) == set(kernels.MODULES)
    others = [file for file in PACKAGE.rglob("*.py") if "njit" in file.read_text()]
    assert _names(others) == {"core.kernels"}


@pytest.mark.long
def test_a_build_compiles_all_kernels_once_and_is_remembered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    modules = ["registration.cliques"]
    assert not kernels.are_built(modules)
    names = list(kernels.build(modules))
    assert len(names) == len(set(names)) == kernels.num_kernels(modules) >= 5
    assert kernels.are_built(modules)
    assert len(list(tmp_path.rglob("*.nbi"))) == len(names)


def test_a_failing_process_is_reported_with_the_reason(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernels, "num_kernels", lambda _: 1)
    monkeypatch.setattr(kernels, "_stamp", lambda _: tmp_path / "stamp")
    with pytest.raises(RuntimeError, match="No module named"):
        list(kernels.build(["nothing"]))
    assert not (tmp_path / "stamp").exists()


def test_compiled_code_is_kept_where_it_can_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    assert kernels.cache_folder() is None  # beside the modules
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    assert kernels.cache_folder() == tmp_path / "given"

    closed = {str(PACKAGE / "registration" / "segregator"), str(tmp_path / "given")}
    monkeypatch.setattr(os, "access", lambda folder, _: str(folder) not in closed)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert kernels.cache_folder() == tmp_path / "home" / "segslam"

    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))  # no folder can be made there
    folder = kernels.cache_folder()
    assert folder is not None
    assert folder.name == f"segslam-{os.getuid()}"
