"""Reports of a benchmark: Markdown, JSON and a self-contained HTML page."""

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import matplotlib

from segslam.bench.experiments import report_figures
from segslam.bench.experiments.report_tables import html, markdown, tables, varied
from segslam.core.config import Config
from segslam.core.whole_files import write_whole
from segslam.output.report import figures
from segslam.output.report.page import (
    document,
    plot_section,
    png_section,
    section,
    settings_not_default,
    settings_tables,
)


def write_bench_report(folder: Path, report: dict[str, Any], *, pictures: Mapping[str, bytes]) -> None:
    """Write `report.json`, `report.md` and `report.html` into a folder; `pictures` maps captions to PNGs.

    Raises SegslamError if the folder cannot be written.
    """
    results = report["results"]
    with matplotlib.rc_context(figures.STYLE):
        if (by := varied(results)) == "list":
            plots = {"Success": report_figures.draw_success(results)}
        else:
            plots = {"Success and errors": report_figures.draw_along(results, by)}
        plots["Times"] = report_figures.draw_times(results)
    files = {
        "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "report.md": _markdown(report),
        "report.html": _page(report, plots, pictures),
    }
    for name, text in files.items():
        write_whole(folder / name, text)


def _title(report: dict[str, Any]) -> str:
    return f"segslam bench {report['experiment']}: {report['data']}"


def _markdown(report: dict[str, Any]) -> str:
    parts = [f"# {_title(report)}\n", "\n".join(f"- {note}" for note in report["notes"]) + "\n"]
    parts += [markdown(table) for table in tables(report)]
    facts = "\n".join(f"- {name}: {value}" for name, value in _facts(report).items())
    return "\n".join([*parts, f"**Conditions**\n\n{facts}\n"])


def _page(report: dict[str, Any], plots: Mapping[str, str], pictures: Mapping[str, bytes]) -> str:
    notes = "".join(f"<p>{escape(note)}</p>" for note in report["notes"])
    facts = "".join(f"<tr><td>{escape(k)}</td><td>{escape(str(v))}</td></tr>" for k, v in _facts(report).items())
    boxes = [section("How to read this", notes)]
    boxes += [section(table.caption, html(table)) for table in tables(report)]
    columns = [plot_section(caption, svg) for caption, svg in plots.items()]
    columns += [png_section(caption, png) for caption, png in pictures.items()]
    settings = settings_tables(Config.model_validate(report["settings"]))
    return document(
        _title(report),
        f'{"".join(boxes)}<div class="plots">{"".join(columns)}</div>'
        f"{section('Conditions', f'<table>{facts}</table>')}{section('Settings', settings)}",
    )


def _facts(report: dict[str, Any]) -> dict[str, Any]:
    """Conditions of the benchmark, except the settings."""
    machine = report["machine"]
    simulation = report["simulation"]
    return {
        "machine": f"{machine['cpu']}, {machine['cores']} cores, {machine['system']}, Python {machine['python']}",
        "load over 15 minutes": machine["load"],
        "commit": report["commit"] or "installed package",
        "packages": ", ".join(f"{name} {version}" for name, version in report["packages"].items()),
        "scans": "real" if simulation is None else f"simulated, seed {simulation['seed']}",
        "labels": report["labels"],
        "pairs": ", ".join(f"{one['name']}: {one['pairs']} of {one['of']}" for one in report["lists"]),
        "options": ", ".join(f"{name} {value}" for name, value in report["options"].items() if value is not None),
        "settings other than the defaults": settings_not_default(Config.model_validate(report["settings"])) or "none",
    }
