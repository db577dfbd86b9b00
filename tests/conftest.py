"""Shapes of array arguments and records are checked while testing; real data is found or its tests skip."""

import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).resolve().parents[1]


def _modules_checked() -> list[str]:
    """All but packages and the modules with compiled kernels: numba cannot cache what the check has wrapped."""
    return [
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for file in sorted((ROOT / "segslam").rglob("*.py"))
        if file.name != "__init__.py" and "njit" not in file.read_text()
    ]


install_import_hook(_modules_checked(), "beartype.beartype")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data; skips the test where there is none."""
    folder = Path(os.environ.get("SEGSLAM_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "kitti").is_dir():
        pytest.skip(f"no real data at {folder}; set SEGSLAM_DATA")
    return folder
