"""`segslam doctor` and `warm-up`: what this machine has, and the compiled code."""

import ctypes
import os
import platform
import re
import sys
from collections import defaultdict
from pathlib import Path
from time import perf_counter
from typing import Any

import typer

from segslam.cli.console import Terminal
from segslam.core.interrupts import when_stopped

LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libgomp.so.1": "libgomp1",
}
"""Shared libraries needed by Open3D, and their packages in Debian and Ubuntu."""


def doctor(*, terminal: Terminal) -> None:
    """Show the environment: versions, shared libraries, processor, memory, display, compiled code.

    Exit status 1 if a required package or library is missing. Example: segslam doctor
    """
    report = examine()
    terminal.table(report, "\n".join(_lines(report)))
    if report["problems"]:
        raise typer.Exit(1)


def warm_up(*, terminal: Terminal) -> None:
    """Compile all numba kernels now instead of in the first run, for example in a container image.

    Compiled code is stored in NUMBA_CACHE_DIR if set, otherwise beside the package, or in the user's cache folder if
    the package is read-only.

    Example: segslam warm-up
    """
    when_stopped("the kernels compiled so far are kept; the same command compiles the others")
    started = perf_counter()
    num_compiled = terminal.compile_kernels()
    seconds = perf_counter() - started
    ready = f"ready in {seconds:.1f} s; {num_compiled} kernels were compiled"
    figures = {"seconds": seconds, "num_compiled": num_compiled}
    terminal.answer(figures, ready if num_compiled else "ready: all kernels are compiled")


def examine() -> dict[str, Any]:
    """All findings; `problems` has a line with the remedy for each missing item."""
    from importlib.metadata import version

    from segslam.core import extras, kernels

    packages: dict[str, dict[str, str | None]] = defaultdict(dict)
    for package, _, extra in extras.requirements():
        if extra != "dev":
            packages[extra or "core"][package] = extras.installed_version(package)
    libraries = {name: _loads(name) for name in LIBRARIES}
    missing = [name for name, found in packages["core"].items() if found is None]
    problems = [f"{name} is not installed: pip install {name}" for name in missing]
    problems += [
        f"{name} cannot be loaded: sudo apt-get install {LIBRARIES[name]}"
        for name, is_there in libraries.items()
        if not is_there
    ]
    folder = kernels.cache_folder()
    return {
        "segslam": version("segslam"),
        "python": platform.python_version(),
        "executable": sys.executable,
        "platform": platform.platform(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": _memory_gb(),
        "display": os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY"),
        "packages": packages,
        "libraries": libraries,
        "kernels": {
            "compiled": kernels.are_built(),
            "number": kernels.num_kernels(),
            "folder": str(folder or kernels.PACKAGE),
        },
        "problems": problems,
    }


def _lines(report: dict[str, Any]) -> list[str]:
    display = report["display"] or "none: use `segslam view RUN --save FILE.rrd`"
    compiled = "compiled" if report["kernels"]["compiled"] else "not compiled yet: `segslam warm-up`"
    lines = [
        f"segslam {report['segslam']}, Python {report['python']} ({report['executable']})",
        report["platform"],
        f"{report['cores']} cores, {report['memory_gb']['available']:.1f} of {report['memory_gb']['total']:.1f} GB of "
        "memory free",
        f"display: {display}",
        f"{report['kernels']['number']} kernels: {compiled} (kept in {report['kernels']['folder']})",
        "shared libraries: " + ", ".join(f"{name} {'yes' if found else 'NO'}" for name, found in
                                         report["libraries"].items()),
    ]  # fmt: skip
    for extra, versions in report["packages"].items():
        shown = ", ".join(f"{name} {found or '-'}" for name, found in versions.items())
        lines.append(f"{'packages' if extra == 'core' else f'extra {extra}'}: {shown}")
    return [*lines, *(f"PROBLEM {problem}" for problem in report["problems"])]


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _memory_gb() -> dict[str, float]:
    text = Path("/proc/meminfo").read_text(encoding="ascii")
    kilobytes = dict(re.findall(r"^(\w+):\s+(\d+) kB$", text, re.MULTILINE))
    return {"total": int(kilobytes["MemTotal"]) / 2**20, "available": int(kilobytes["MemAvailable"]) / 2**20}
