"""Conditions of a benchmark: machine, versions, data, settings. They contain no names of users or folders."""

import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from segslam.bench.experiments.job import Job
from segslam.bench.experiments.pairs import PairList
from segslam.bench.simulation.files import SETTINGS_FILE
from segslam.core.extras import installed_version
from segslam.output.log.schema import processor

PACKAGES = ("segslam", "numpy", "scipy", "numba", "open3d", "small-gicp", "kiss-matcher", "dask", "distributed")


def machine() -> dict[str, Any]:
    """Processor, cores, system, and the load average over 15 minutes (1: one busy core)."""
    return {
        "cpu": processor(),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[2], 1),
        "system": _system(),
        "python": platform.python_version(),
    }


def commit() -> str | None:
    """Commit of the source tree, marked if it was changed since; None for an installed package."""
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


def _system() -> str:
    """Name of the distribution on Linux."""
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        return f"{platform.system()} {platform.release()}"


def account(
    experiment: str, job: Job, lists: Sequence[PairList], results: dict[str, Any], *, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Content of `report.json`: what was measured, under which conditions, and the results."""
    data = job.source.data
    files = [folder / SETTINGS_FILE for folder in (data, data / "sequences" / job.source.sequence.zfill(2))]
    simulation = next((json.loads(file.read_text(encoding="utf-8")) for file in files if file.is_file()), None)
    return {
        "experiment": experiment,
        "data": f"{job.source.dataset or 'kitti'} {job.source.sequence}",
        "simulation": simulation,
        "lists": [{"name": one.name, "pairs": len(one.pairs), "of": one.num_whole} for one in lists],
        "notes": _notes(simulation, lists, job.source.labels),
        "options": dict(options),
        "machine": machine(),
        "commit": commit(),
        "packages": {name: found for name in PACKAGES if (found := installed_version(name))},
        "methods": list(job.methods),
        "labels": Path(job.source.labels).name,
        "settings": job.config.model_dump(mode="json"),
        "results": results,
    }


def _notes(simulation: dict[str, Any] | None, lists: Sequence[PairList], labels: str) -> list[str]:
    """Notes needed to compare the results with those of the paper."""
    notes = []
    if simulation is not None:
        known = ", with true labels" if labels in ("auto", "labels") else ""
        notes.append(
            f"The scans were SIMULATED (seed {simulation['seed']}), at the real poses if they are KITTI's{known}. "
            "No result here was measured on KITTI's own scans."
        )
    if sampled := [one for one in lists if len(one.pairs) < one.num_whole]:
        counts = ", ".join(f"{one.name} {len(one.pairs)} of {one.num_whole}" for one in sampled)
        notes.append(f"The lists were SAMPLED: {counts}.")
    if any(one.truth is None for one in lists) and simulation is None:
        notes.append("True poses are those of KITTI; they have errors of up to 1.6 m on some pairs of 00.")
    return [
        *notes,
        "Success: error of T_estimate inv(T_true) below 2 m and 5 degrees. Errors are means over successes.",
        "Times are those of a single registration: labels by geometry if used, preparation of both scans, alignment; "
        "reading of files is excluded. CPU time is summed over all threads; MB is the peak of additional memory.",
    ]
