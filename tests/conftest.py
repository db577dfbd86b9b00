"""Shapes of array arguments and records are checked while testing; real data is found or its tests skip."""

import json
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # as many processes as cores: their threads only wait for each other
    for library in ("OMP", "OPENBLAS", "NUMBA"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import helpers.checker
import hypothesis
import numpy as np
import pytest
from jaxtyping import install_import_hook
from kiss_icp.pybind import kiss_icp_pybind

ROOT = Path(__file__).resolve().parents[1]


def _modules_checked() -> list[str]:
    """All but the modules with compiled kernels, and packages with such: numba cannot cache what the check wraps."""
    files = sorted((ROOT / "segslam").rglob("*.py"))
    compiled = [file for file in files if "import kernel\n" in file.read_text()]
    packages = {folder / "__init__.py" for file in compiled for folder in file.parents}
    packages.add(ROOT / "segslam" / "cli" / "__init__.py")  # typer passes None for a flag
    checked = [file.relative_to(ROOT) for file in files if file not in (*compiled, *packages)]
    return [".".join(file.with_suffix("").parts).removesuffix(".__init__") for file in checked]


install_import_hook(_modules_checked(), "helpers.checker.check")
hypothesis.settings.register_profile("steady", deadline=None)  # a slow machine is no failure
hypothesis.settings.load_profile("steady")


def pytest_runtest_setup() -> None:
    helpers.checker.begin_test()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data; skips the test where there is none."""
    folder = Path(os.environ.get("SEGSLAM_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "kitti").is_dir():
        pytest.skip(f"no real data at {folder}; set SEGSLAM_DATA")
    return folder


@pytest.fixture
def ctrl_c_works() -> Iterator[None]:
    """Ctrl-C interrupts the test and the processes that it starts, though a script's job and xdist ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def short_runs() -> Iterator[None]:
    """Runs without what takes longer than mapping a few scans: drawings in the report, a process for KISS-ICP."""
    from helpers.finished_run import write_blank_report  # after the hook, which checks what it imports
    from helpers.short_odometry import OdometryHere

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("segslam.odometry.apart.OdometryApart", OdometryHere)
        patch.setattr("segslam.output.report.write_report", write_blank_report)
        yield


@dataclass(frozen=True)
class Pair:
    source: int
    target: int
    T_target_source: np.ndarray


class RealPairs:
    """The reference pairs of real scans of KITTI 00, corrected for the vertical angle by kiss_icp's own function."""

    def __init__(self, kitti: Path) -> None:
        self._velodyne = kitti / "sequences" / "00" / "velodyne"
        rows = json.loads((kitti / "reference_pairs.json").read_text())
        self.pairs = [Pair(row["source"], row["target"], np.array(row["T_target_source"])) for row in rows]

    @cache  # noqa: B019  (a session's fixture: lives as long as the tests)
    def points(self, index: int) -> np.ndarray:
        """(n, 3) float64 of one scan, without the vehicle's own roof."""
        raw = np.fromfile(self._velodyne / f"{index:06d}.bin", np.float32).reshape(-1, 4)[:, :3].astype(float)
        points = np.asarray(kiss_icp_pybind._correct_kitti_scan(kiss_icp_pybind._Vector3dVector(raw)))
        return points[np.linalg.norm(points, axis=1) > 3.0]


@pytest.fixture(scope="session")
def real_pairs(data_dir: Path) -> RealPairs:
    return RealPairs(data_dir / "kitti")
