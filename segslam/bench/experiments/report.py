"""Reports of a benchmark: Markdown, JSON and a self-contained HTML page with plots."""

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from segslam.bench.experiments.report_tables import TITLES, html, markdown, tables, varied
from segslam.core.config import Config
from segslam.core.whole_files import write_whole
from segslam.output.report import figures
from segslam.output.report.figures import plain_powers, svg
from segslam.output.report.page import document, picture_section, section, settings_not_default, settings_tables, table

COLORS = ["#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8C564B", "#7F7F7F", "#1F3A93", "#BCBD22"]
"""A colour for each method; first those of Okabe and Ito."""
LEAST = 1e-3
"""Lower limit of the logarithmic plots (m, degrees)."""


def draw_success(results: dict[str, Any]) -> str:
    """Success rate of each method by list, with the paper's values as diamonds."""
    lists = [one["list"] for one in next(iter(results.values()))["by"]]
    figure = Figure(figsize=(6.4, 1.2 + 0.24 * len(lists) * len(results)), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(lists)) * (len(results) + 1.0)
    for number, (method, own) in enumerate(results.items()):
        at = places + number
        axes.barh(at, [one["success_percent"] for one in own["by"]], color=COLORS[number], label=method)
        for y, one in zip(at, own["by"], strict=True):
            if "paper" in one:
                axes.plot(one["paper"]["success_percent"], y, "D", color="black", markersize=4)
    if any("paper" in one for own in results.values() for one in own["by"]):
        axes.plot([], [], "D", color="black", markersize=4, label="paper")
    axes.set(xlabel="success (%)", xlim=(0, 102))
    axes.set_yticks(places + (len(results) - 1) / 2, lists)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    _legend(axes)
    return svg(figure, "success")


def draw_times(results: dict[str, Any]) -> str:
    """Median and 95th percentile of the registration time."""
    figure = Figure(figsize=(6.4, 1.0 + 0.32 * len(results)), layout="constrained")
    axes = figure.subplots()
    methods = list(results)
    axes.barh(methods, [results[name]["p95_ms"] or 0.0 for name in methods], color="#CFE3F1", label="95th percentile")
    axes.barh(methods, [results[name]["median_ms"] or 0.0 for name in methods], height=0.45, label="median")
    axes.set(xlabel="time of a registration (ms)", xscale="log")
    axes.set_xlim(left=10)
    plain_powers(axes.xaxis)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    _legend(axes)
    return svg(figure, "times")


def draw_along(results: dict[str, Any], by: str) -> str:
    """Success rate and mean errors of all returned poses against the varied quantity."""
    figure = Figure(figsize=(6.4, 8.0), layout="constrained")
    success, metres, degrees = figure.subplots(3, 1, sharex=True)
    for place, (method, own) in enumerate(results.items()):
        x = [one[by] for one in own["by"]]
        style: dict[str, Any] = {"color": COLORS[place], "marker": ".", "linewidth": 1.3}
        success.plot(x, [one["success_percent"] for one in own["by"]], label=method, **style)
        metres.plot(x, _logarithmic(own["by"], "accepted_m"), **style)
        degrees.plot(x, _logarithmic(own["by"], "accepted_deg"), **style)
    success.set(ylabel="success (%)", ylim=(-3, 103))
    metres.set(ylabel="mean error (m)", yscale="log")
    degrees.set(ylabel="mean error (deg)", yscale="log", xlabel=TITLES[by])
    for axes in (metres, degrees):
        plain_powers(axes.yaxis)
    _legend(success)
    return svg(figure, by)


def _logarithmic(by: list[dict[str, Any]], key: str) -> list[float]:
    """Values for a logarithmic plot; NaN where no pose was returned."""
    return [np.nan if one[key] is None else max(one[key], LEAST) for one in by]


def _legend(axes: Axes) -> None:
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, borderaxespad=0.2, fontsize=9)


def write_bench_report(folder: Path, report: dict[str, Any], *, pictures: Mapping[str, bytes]) -> None:
    """Write `report.json`, `report.md` and `report.html` into a folder, and `pictures`, by caption, as PNG files.

    Raises SegslamError if the folder cannot be written.
    """
    results = report["results"]
    with matplotlib.rc_context(figures.STYLE):
        if (by := varied(results)) == "list":
            plots = {"Success": draw_success(results)}
        else:
            plots = {"Success and errors": draw_along(results, by)}
        plots["Times"] = draw_times(results)
    files = {
        "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "report.md": _markdown(report),
        "report.html": _page(report, plots, pictures),
    }
    for name, text in files.items():
        write_whole(folder / name, text)
    for number, png in enumerate(pictures.values()):
        write_whole(folder / f"failure_{number:02d}.png", png)


def _title(report: dict[str, Any]) -> str:
    return f"segslam bench {report['experiment']}: {report['data']}"


def _markdown(report: dict[str, Any]) -> str:
    parts = [f"# {_title(report)}\n", "\n".join(f"- {note}" for note in report["notes"]) + "\n"]
    parts += [markdown(one) for one in tables(report)]
    facts = "\n".join(f"- {name}: {value}" for name, value in _facts(report).items())
    return "\n".join([*parts, f"**Conditions**\n\n{facts}\n"])


def _page(report: dict[str, Any], plots: Mapping[str, str], pictures: Mapping[str, bytes]) -> str:
    notes = "".join(f"<p>{escape(note)}</p>" for note in report["notes"])
    facts = table((escape(name), escape(str(value))) for name, value in _facts(report).items())
    boxes = [section("How to read this", notes)]
    boxes += [section(one.caption, html(one)) for one in tables(report)]
    columns = [picture_section(caption, svg) for caption, svg in plots.items()]
    columns += [picture_section(caption, png) for caption, png in pictures.items()]
    settings = settings_tables(Config.model_validate(report["settings"]), Config())
    return document(
        _title(report),
        f'{"".join(boxes)}<div class="plots">{"".join(columns)}</div>'
        f"{section('Conditions', facts)}{section('Settings', settings)}",
    )


def _facts(report: dict[str, Any]) -> dict[str, Any]:
    """Conditions of the benchmark, except the settings."""
    machine = report["machine"]
    simulation, settings = report["simulation"], Config.model_validate(report["settings"])
    return {
        "machine": f"{machine['cpu']}, {machine['cores']} cores, {machine['system']}, Python {machine['python']}",
        "load over 15 minutes": machine["load"],
        "commit": report["commit"] or "installed package",
        "packages": ", ".join(f"{name} {version}" for name, version in report["packages"].items()),
        "scans": "real" if simulation is None else f"simulated, seed {simulation['seed']}",
        "labels": report["labels"],
        "pairs": ", ".join(f"{one['name']}: {one['pairs']} of {one['of']}" for one in report["lists"]),
        "options": ", ".join(f"{name} {value}" for name, value in report["options"].items() if value is not None),
        "settings other than the defaults": settings_not_default(settings, Config()) or "none",
    }
