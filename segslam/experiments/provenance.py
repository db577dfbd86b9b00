"""Under what conditions figures were measured: machine, versions, data, settings. No names of users or folders."""

import json
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

from segslam.experiments.job import Job
from segslam.simulation.files import SETTINGS_FILE

PACKAGES = (
    "segslam",
    "numpy",
    "scipy",
    "numba",
    "open3d",
    "small-gicp",
    "kiss-matcher",
    "dask",
    "distributed",
)
CPU_INFO = Path("/proc/cpuinfo")


def conditions(job: Job) -> dict[str, Any]:
    """What a reader needs to judge the figures, or to measure them again."""
    return {
        "machine": machine(),
        "commit": commit(),
        "packages": _versions(),
        "methods": list(job.methods),
        "labels": Path(job.source.labels).name,
        "settings": job.config.model_dump(mode="json"),
    }


def machine() -> dict[str, Any]:
    """Processor, cores and system."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
    }


def commit() -> str | None:
    """That of the source tree, marked where it was changed since; None for an installed package."""
    folder = Path(__file__).resolve().parent
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def simulation_of(job: Job) -> dict[str, Any] | None:
    """Seed and settings of the simulator that made the scans; None if they are real."""
    data = job.source.data
    for folder in (data, data / "sequences" / job.source.sequence.zfill(2)):
        file = folder / SETTINGS_FILE
        if file.is_file():
            return json.loads(file.read_text(encoding="utf-8"))
    return None


def _cpu_model() -> str:
    """As Linux tells it; elsewhere what Python knows."""
    if CPU_INFO.is_file():
        for line in CPU_INFO.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _versions() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
