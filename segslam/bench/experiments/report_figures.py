"""The plots of a benchmark."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from segslam.bench.experiments.report_tables import TITLES
from segslam.output.report.figures import plain_powers, svg

COLORS = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
    "#8C564B",
    "#7F7F7F",
    "#1F3A93",
    "#BCBD22",
)  # first colours of Okabe and Ito
LEAST_M, LEAST_DEG = 1e-3, 1e-3
"""Lower limit of the logarithmic plots."""


def draw_success(results: dict[str, Any]) -> str:
    """Success rate of each method by list, with the paper's values as diamonds."""
    lists = [one["list"] for one in next(iter(results.values()))["by"]]
    figure = Figure(figsize=(6.4, 1.2 + 0.24 * len(lists) * len(results)), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(lists)) * (len(results) + 1.0)
    for number, (method, own) in enumerate(results.items()):
        at = places + number
        axes.barh(at, [one["success_percent"] for one in own["by"]], color=_color(number), label=method)
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
        style: dict[str, Any] = {"color": _color(place), "marker": ".", "linewidth": 1.3}
        success.plot(x, [one["success_percent"] for one in own["by"]], label=method, **style)
        metres.plot(x, _logarithmic(own["by"], "accepted_m", LEAST_M), **style)
        degrees.plot(x, _logarithmic(own["by"], "accepted_deg", LEAST_DEG), **style)
    success.set(ylabel="success (%)", ylim=(-3, 103))
    metres.set(ylabel="mean error (m)", yscale="log")
    degrees.set(ylabel="mean error (deg)", yscale="log", xlabel=TITLES[by])
    for axes in (metres, degrees):
        plain_powers(axes.yaxis)
    _legend(success)
    return svg(figure, by)


def _logarithmic(by: list[dict[str, Any]], key: str, least: float) -> list[float]:
    """Values for a logarithmic plot; NaN where no pose was returned."""
    return [np.nan if one[key] is None else max(one[key], least) for one in by]


def _color(number: int) -> str:
    return COLORS[number % len(COLORS)]


def _legend(axes: Axes) -> None:
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, borderaxespad=0.2, fontsize=9)
